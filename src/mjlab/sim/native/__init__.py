"""MuJoCo's own batch engine on CPU threads."""
