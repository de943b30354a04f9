"""BVH files, and the joint maps that read them as a named skeleton."""
