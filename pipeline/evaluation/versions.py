"""Versions of the evaluating stages, for those who read their figures without loading any stage.

A version changes whenever a figure keeps its name and changes its meaning.
"""

from __future__ import annotations

EVALUATE = 5
"""The papers' definitions, clips drawn as they come; TMA reads captions by its own encoder."""

EVALUATE_DANCES = 1
