"""The models of a finished search: the refit and its check, the stack, and which one to use."""
