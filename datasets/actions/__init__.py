"""Rules that recognise on joints what a motion does: for evaluation, and for models whose clips state it."""
