"""Drawing toolkit for matplotlib: style, time axes, panels, places for text."""
