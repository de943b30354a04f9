"""MotionDiffuse (Zhang et al. 2022): noise predicted by attention linear in the frames."""
