"""Import of task packages."""
