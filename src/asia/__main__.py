"""`python -m asia`: the command line."""

from asia.interfaces.cli import main

main()
