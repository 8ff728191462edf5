"""The levels of isolation, one file each."""
