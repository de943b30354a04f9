"""MotionCLIP: motion in the space of a frozen text encoder (Tevet et al., ECCV 2022)."""
