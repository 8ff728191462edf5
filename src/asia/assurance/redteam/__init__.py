"""Scripted cheats that must fail, and honest candidates that must not be taken for cheats.

Shipped, so that everybody can try them on their own machine: `asia doctor --attack`."""
