"""Report of a trained grey-box: its parameters with their uncertainty, its equations."""
