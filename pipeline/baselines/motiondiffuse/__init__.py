"""MotionDiffuse (Zhang et al. 2022)."""
