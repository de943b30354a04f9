"""TM2T (Guo et al. 2022)."""
