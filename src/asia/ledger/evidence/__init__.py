"""What is shown of an experiment beside its score, to agents and to people alike."""
