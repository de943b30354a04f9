"""Sets read by their published layouts: one file describes each, `shared/` does the work."""
