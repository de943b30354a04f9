"""Bailando (Siyao et al. 2022)."""
