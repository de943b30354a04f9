"""Training batches of shards."""
