"""Base converters of published sets, and readers of their lists and vectors."""
