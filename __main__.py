"""`python -m motionloom`: the command line."""

from motionloom.pipeline.cli.main import main

if __name__ == "__main__":  # a tool that imports every module, to list or document them, starts no command
    main()
