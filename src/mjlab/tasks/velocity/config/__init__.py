"""The robots that the velocity task comes with, one package each."""
