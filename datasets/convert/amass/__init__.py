"""AMASS to shards."""
