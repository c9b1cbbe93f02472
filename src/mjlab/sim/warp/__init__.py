"""MuJoCo Warp on NVIDIA GPUs, or on the CPU to test that path."""
