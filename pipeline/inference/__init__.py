"""From trained stages to motions and files."""
