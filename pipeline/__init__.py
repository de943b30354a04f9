"""Command line, recipes, the stage graph, training, generation and pages."""
