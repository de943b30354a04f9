"""Several runs side by side, read from their files alone."""
