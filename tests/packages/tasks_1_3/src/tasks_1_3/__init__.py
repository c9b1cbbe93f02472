"""A task for release 1.3: an arm that reaches for a pose."""
