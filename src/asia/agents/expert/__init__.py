"""The default agent."""
