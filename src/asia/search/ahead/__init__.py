"""Several experiments at a time: proposed ahead of results, recorded in the order of proposal."""
