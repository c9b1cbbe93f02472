"""Warp engine: MuJoCo Warp on NVIDIA GPUs, or on the CPU for testing."""
