"""Procedural whole-body motion with captions that are true."""
