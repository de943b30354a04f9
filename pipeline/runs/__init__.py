"""Recipes, the stage graph and the Python API."""
