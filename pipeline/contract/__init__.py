"""What a stage answers for itself, and what the rest of the pipeline asks of it."""
