"""Music: songs with a genre, a tempo and a form, and what plays and records them."""
