"""Converters from raw sources to shards, one file each."""
