"""A package that adds to motionloom: stages, a generator, a converter, a metric, a format and a modality."""
