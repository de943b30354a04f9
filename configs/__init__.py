"""Recipes: one readable YAML file per run, checked against the typed configs they fill."""
