"""Modalities that motion can be conditioned on: a record in a file of its own for each, and their table."""

from motionloom.datasets.modalities import table as table  # ours are there before anybody adds one
