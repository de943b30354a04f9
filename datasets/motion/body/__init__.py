"""Bodies: SMPL files, rigid figures, feet, hands and faces."""
