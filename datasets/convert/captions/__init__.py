"""Captions that people bring for their clips, in any of six forms."""
