"""The training loop of a stage: execution, checkpoints and resume, preemption, failures, telemetry, logs."""
