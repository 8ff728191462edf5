"""`python -m asia`: the command line."""

from asia.cli import main

main()
