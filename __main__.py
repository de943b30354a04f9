"""`python -m motionloom`: the command line."""

from motionloom.pipeline.cli.main import main

main()
