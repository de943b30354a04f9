"""Colours of the figure: orange is right, blue is left."""

from __future__ import annotations

Colour = tuple[int, int, int]
PALETTE: dict[int, Colour] = {0: (119, 130, 154), 1: (47, 143, 196), 2: (229, 121, 63), 3: (237, 199, 163)}
"""Trunk, left, right and skin, by the codes of `figure.py`."""
HAIR: Colour = (90, 68, 54)
