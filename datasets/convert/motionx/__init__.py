"""Motion-X to shards."""
