"""The kernel of every network's training."""
