"""A recipe on a cluster that another engine schedules: SLURM, Kubernetes, SkyPilot."""
