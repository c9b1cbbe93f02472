"""Command lines of motion tracking, at the paths of mjlab 1.6."""
