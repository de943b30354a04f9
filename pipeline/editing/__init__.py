"""Editing: a clip of which a part is kept and the rest made anew, on the command line, in Python and a
page."""
