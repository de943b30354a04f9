"""Text-motion alignment (HumanTOMATO section 3.5, appendix D)."""
