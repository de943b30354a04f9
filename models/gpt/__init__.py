"""Hierarchical-GPT over interleaved token streams (HumanTOMATO sections 3.3-3.6)."""
