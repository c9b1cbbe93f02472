"""The `cpu` profile of the cartpole swing-up. `docs/guides/learning.md` has the experiments."""

from __future__ import annotations

from mjlab.tasks.cpu_profile import cpu_profile

cpu = cpu_profile(
    num_steps_per_env=24,
    hidden_dims=(64, 64),
    desired_kl=0.05,
    gamma=0.98,
    max_iterations=500,
)
"""Profile of `Mjlab-Cartpole-Swingup`."""
