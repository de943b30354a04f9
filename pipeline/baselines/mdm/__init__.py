"""MDM (Tevet et al. 2023)."""
