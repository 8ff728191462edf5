"""Tables and sentences of results, the same for the terminal, pages, LaTeX and agents."""
