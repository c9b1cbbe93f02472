"""Import of whole packages of tasks."""
