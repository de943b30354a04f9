"""Trained models that come with the package: one exported folder each, found by its name."""
