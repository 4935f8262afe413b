"""`python -m pipeline` does what the command `pipeline` does, where scripts are not on the search path."""

from pipeline.cli import main

main()
