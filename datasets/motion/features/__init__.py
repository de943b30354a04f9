"""Motion features: joints to columns and back."""
