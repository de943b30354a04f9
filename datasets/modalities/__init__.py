"""What motion can be conditioned on: a record for each modality in a file of its own, and their table."""
