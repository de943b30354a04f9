"""MotionCLIP (Tevet et al. 2022)."""
