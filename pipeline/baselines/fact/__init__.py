"""FACT (Li et al. 2021)."""
