"""The robots that the manipulation tasks come with, one package each."""
