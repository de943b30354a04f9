"""The kinds of stages: data, networks of the papers, results; the baselines' are in `pipeline.baselines`."""
