"""Controllers and what they need of a model: the first plug-in, which nothing else imports."""
