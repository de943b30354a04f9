"""Guessing a joint map: which joints of a foreign skeleton stand for ours."""
