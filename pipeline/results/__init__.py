"""Figures of finished runs, beside each other and beside the papers'; the page about a data set."""
