"""Red team: scripted cheats that must fail, and honest candidates that must not be flagged.

`python -m tests.redteam` in a checkout runs them on this machine.
"""
