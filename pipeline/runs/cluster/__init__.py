"""A recipe on a cluster: SLURM, Kubernetes, SkyPilot."""
