"""Bundles: a policy with all that a robot needs to run it, without this package and without torch.

`terms` says what each observation computes from which measurement, `contract` gathers everything in one
dictionary, `golden` records what the training environment does, and `bundle` writes the folder.
"""
