"""The models that the papers compare themselves with, one folder each."""
