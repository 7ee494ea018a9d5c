"""Which cameras train which block: scores, the decision, its file, its tables."""
