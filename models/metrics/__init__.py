"""Retrieval and reconstruction metrics."""
