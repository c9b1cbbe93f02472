"""Parts of `mjlab sweep`: settings, training processes, database, comparison."""
