"""MLD (Chen et al. 2023)."""
