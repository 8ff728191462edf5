"""Pictures and pages of a run and of a problem; reads ledger views and artifacts, scores nothing."""
