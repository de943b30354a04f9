"""Skeletons, layouts, features and BVH: the bottom layer (numpy, torch, roma only)."""
