"""Motion to words and words to motion tokens (TM2T, Guo et al. 2022)."""
