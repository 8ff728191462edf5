"""Evidence on an experiment besides its score, for agents and users alike."""
