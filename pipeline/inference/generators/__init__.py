"""Generators: trained networks as makers of motion (`contract/generation.py`)."""
