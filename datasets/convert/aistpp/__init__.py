"""AIST++ to shards."""
