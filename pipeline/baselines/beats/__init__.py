"""The beat network's training: songs with known beats (`songs`), and the network that learns from them."""
