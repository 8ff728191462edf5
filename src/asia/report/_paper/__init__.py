"""What a paper needs of a run: figures, tables, and the paragraph on methods."""
