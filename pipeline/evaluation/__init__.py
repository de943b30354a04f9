"""Figures of a run, each beside reference baselines that need no model."""
