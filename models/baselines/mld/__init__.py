"""MLD: motion of text by diffusion of one latent (Chen et al., CVPR 2023)."""
