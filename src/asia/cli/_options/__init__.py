"""Options of the commands: what several commands share, and groups of options as dataclasses."""
