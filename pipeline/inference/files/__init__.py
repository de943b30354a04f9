"""Motions as files: what writers take, the figure that they show, the formats, and folders of them."""
