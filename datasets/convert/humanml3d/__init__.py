"""HumanML3D to shards."""
