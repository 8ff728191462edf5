"""One file a kind of family: its row, its moves."""
