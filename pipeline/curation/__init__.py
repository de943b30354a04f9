"""Searching a data set by words or likeness, and cleaning it: suspects on a page to decide about."""
