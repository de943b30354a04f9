"""BVH to shards."""
