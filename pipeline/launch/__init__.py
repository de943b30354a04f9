"""Where and in which processes a run executes."""
