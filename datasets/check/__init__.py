"""Checks of data sets and of single source files."""
