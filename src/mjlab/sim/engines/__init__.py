"""The two implementations of `mjlab.sim.engine.Engine`. Nothing is imported until one is chosen."""
