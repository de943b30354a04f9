"""Parts that all converters share: configs, plans, splits, files, features."""
