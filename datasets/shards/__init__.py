"""WebDataset shards with an index: write, check, read at random."""
