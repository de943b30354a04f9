"""Figures of a run, each beside its trivial answer."""
