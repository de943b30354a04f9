"""The models that the papers compare themselves with, a folder each; nothing outside imports them."""
