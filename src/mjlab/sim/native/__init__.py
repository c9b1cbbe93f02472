"""Native engine: MuJoCo's batch engine on CPU threads."""
