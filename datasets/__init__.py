"""Motion, shards, readers, converters and text conditions."""
