"""The network that edits, its training, and how it fills in what a task leaves free."""
