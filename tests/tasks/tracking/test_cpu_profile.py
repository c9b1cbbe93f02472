"""The `cpu` profile makes motion tracking easier to learn, and not easier to pass."""

from __future__ import annotations

import copy
from types import SimpleNamespace

import pytest
from tracking_tasks import G1, G1_BLIND

from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.tasks.tracking.config.cpu_profile import cpu


@pytest.mark.parametrize("task", [G1, G1_BLIND])
def test_a_step_takes_as_long_with_coarse_physics(task):
    plain, eased = load_env_cfg(task), load_env_cfg(task, profile="cpu")
    assert eased.sim.mujoco.timestep == 2 * plain.sim.mujoco.timestep
    for cfg in (plain, eased):
        assert cfg.sim.mujoco.timestep * cfg.decimation == pytest.approx(0.02)


@pytest.mark.parametrize(("counter", "part"), [(0, 0.0), (1000, None), (10**6, 1.0)])
def test_starts_are_perturbed_more_and_more_and_in_evaluations_as_in_the_task(counter, part):
    env_cfg, rl_cfg, table = load_env_cfg(G1), load_rl_cfg(G1), load_env_cfg(G1)
    cpu(env_cfg, rl_cfg)
    motion = SimpleNamespace(cfg=env_cfg.commands["motion"])
    env = SimpleNamespace(
        common_step_counter=counter, command_manager=SimpleNamespace(get_term=lambda _: motion)
    )
    growing = env_cfg.curriculum["eased_starts"]
    fraction = growing.func(env, slice(None), **growing.params)
    assert fraction == part or (part is None and 0.0 < fraction < 0.5)
    full = table.commands["motion"]
    for name in ("pose_range", "velocity_range"):
        ranges = getattr(full, name)
        expected = {axis: (fraction * a, fraction * b) for axis, (a, b) in ranges.items()}
        assert getattr(motion.cfg, name) == expected
    assert motion.cfg.joint_position_range == (-0.1 * fraction, 0.1 * fraction)
    # Training edits the config that evaluations copy.
    copied = copy.deepcopy(env_cfg)
    rl_cfg.evaluation.prepare_env(copied)
    for name in ("pose_range", "velocity_range", "joint_position_range"):
        assert getattr(copied.commands["motion"], name) == getattr(full, name)
