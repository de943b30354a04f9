"""Motion diffusion that predicts x0 (the facial baseline of HumanTOMATO B.5.2, after MDM)."""
