"""What commands print: words and numbers, one experiment, a search that runs."""
