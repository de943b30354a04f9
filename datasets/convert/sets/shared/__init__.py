"""What the converters of published sets share."""
