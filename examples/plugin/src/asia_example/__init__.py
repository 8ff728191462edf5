"""Parts for ASIA in a package of their own: a model family, an agent, a source and a metric."""
