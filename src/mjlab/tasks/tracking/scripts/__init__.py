"""Motion tracking commands at the module paths of mjlab 1.6."""
