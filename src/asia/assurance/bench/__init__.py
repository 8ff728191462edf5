"""The paper's comparisons, rerun: expert against random search, under each early-stopping setting.

Every search is a run of its own, so a comparison that was interrupted goes on where it was."""
