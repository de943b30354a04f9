"""Songs played by a band, and the beat tracker that learns from them; nothing outside imports them."""
