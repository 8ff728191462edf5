"""Pictures and pages of runs and problems; reads ledger views and artifacts, scores nothing."""
