"""The discriminator that UDE trains against, and its losses."""
