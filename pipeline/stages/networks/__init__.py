"""Stages that train, and what they make of their networks."""
