"""Pictures and pages of a run and of a problem, from ledger views and artifacts; nothing is scored."""
