"""One class a kind of file."""
