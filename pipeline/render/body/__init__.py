"""A skinned body of our own: made from implicit shapes, with hands, a head and expression shapes."""
