"""Skeleton data files (JSON)."""
