"""Converters from raw sources to shards, one folder each."""
