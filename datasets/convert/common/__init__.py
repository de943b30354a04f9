"""What every converter shares."""
