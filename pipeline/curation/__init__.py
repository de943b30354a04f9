"""Searching a data set by words or likeness, cleaning it by a page of suspects, and captions of clips."""
