"""Model library for agents, and the types of a family's card."""
