"""The tables of the papers: their numbers, and rows of one's own runs beside them."""
