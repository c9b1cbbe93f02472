"""`cpu` profile: motion tracking is easier to learn, not easier to pass."""

from __future__ import annotations

import pytest
from tracking_tasks import G1, G1_BLIND

from mjlab.tasks.registry import load_env_cfg


@pytest.mark.parametrize("task", [G1, G1_BLIND])
def test_a_step_takes_as_long_with_coarse_physics(task):
    plain, eased = load_env_cfg(task), load_env_cfg(task, profile="cpu")
    assert eased.sim.mujoco.timestep == 2 * plain.sim.mujoco.timestep
    for cfg in (plain, eased):
        assert cfg.sim.mujoco.timestep * cfg.decimation == pytest.approx(0.02)
