"""Encoders of what a motion is conditioned on."""
