"""Editing: a clip, what is asked of it in frames, and what comes of it."""
