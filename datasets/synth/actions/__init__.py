"""Animators of the synthetic source: truths, poses in animator's terms, and the actions."""
