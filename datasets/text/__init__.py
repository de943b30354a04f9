"""Text encoders and the caption cache."""
