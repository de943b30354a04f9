"""Motion tokenizers: H2VQ, vanilla VQ, RVQ, face RVQ (HumanTOMATO section 3.2)."""
