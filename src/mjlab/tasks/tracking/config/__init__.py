"""The robots that imitate motions."""
