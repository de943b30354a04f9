"""Sets whose people are parameters of SMPL, SMPL-H or SMPL-X."""
