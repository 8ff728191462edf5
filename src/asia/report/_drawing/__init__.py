"""What the pictures are drawn with: style, time axes, panels, places for text."""
