"""A robot's model file turned into the values of a task, each with its reason."""
