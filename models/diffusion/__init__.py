"""Motion diffusion: from text to x0 (HumanTOMATO B.5.2, after MDM), from tokens to noise (UDE 3.4)."""
