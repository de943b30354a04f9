"""The interfaces of stages, generators and captioners that the rest of the pipeline relies on."""
