"""Versions of the evaluating stages, for those who read their figures without loading any stage.

A version changes whenever a figure keeps its name and changes its meaning.
"""

from __future__ import annotations

EVALUATE = 6
"""5: the papers' definitions, clips drawn as they come; TMA reads captions by its own encoder.
6: generated in even pieces of the clips, each with its seed; physics, joints' errors, confusions, cases."""

EVALUATE_DANCES = 2
"""2: generated in even pieces of the clips, each with its seed."""
