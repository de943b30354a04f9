"""Characters of others, VRM and GLB: motions on them and from them. Nothing outside imports this."""
