"""State of an environment under other settings: it does not undo them."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.envs.env_state import settings_of
from mjlab.tasks.registry import load_env_cfg

GO1 = "Mjlab-Velocity-Flat-Unitree-Go1"
TRACKING = "Mjlab-Tracking-Flat-Unitree-G1"


def set_at(cfg: Any, path: str, value: Any) -> None:
    """Set the field, entry or item of `cfg` at a dotted path."""
    *holders, last = path.split(".")
    for part in holders:
        cfg = (
            getattr(cfg, part) if hasattr(cfg, part) else cfg[int(part) if part.isdigit() else part]
        )
    if isinstance(cfg, dict):
        cfg[last] = value
    else:
        setattr(cfg, last, value)


@pytest.fixture
def make(request) -> Callable[..., ManagerBasedRlEnv]:
    """Return a function that builds a small environment of Go1 with changes by dotted path."""

    def make(changes: dict[str, Any] | None = None, num_envs: int = 2) -> ManagerBasedRlEnv:
        cfg = load_env_cfg(GO1)
        cfg.scene.num_envs, cfg.seed = num_envs, 3
        for path, value in (changes or {}).items():
            set_at(cfg, path, value)
        env = ManagerBasedRlEnv(cfg, device="cpu")
        request.addfinalizer(env.close)
        env.reset()
        return env

    return make


SETTINGS: dict[str, Any] = {
    "decimation": 2,
    "is_finite_horizon": True,
    "sim.mujoco.timestep": 0.002,
    "scene.entities.robot.init_state.pos": (0.0, 0.0, 0.6),
    "scene.entities.robot.articulation.actuators.0.stiffness": 5.0,
    "actions.joint_pos.scale": 0.1,
    "observations.actor.enable_corruption": False,
    "observations.actor.terms.joint_vel.delay_max_lag": 2,
    "rewards.track_linear_velocity.weight": 9.0,
    "terminations.fell_over.params.limit_angle": 0.1,
    "commands.twist.ranges.lin_vel_x": (0.0, 0.1),
    "events.push_robot.params.velocity_range": {"x": (0.0, 0.1)},
}


@pytest.mark.parametrize("path", SETTINGS)
def test_a_state_of_other_settings_is_not_restored(make, path):
    saved = copy.deepcopy(make().state_dict())
    env = make({path: SETTINGS[path]})
    before = env.state_dict()["sim"]["state"].clone()
    with pytest.raises(ValueError, match=path.replace(".", r"\.")):
        env.load_state_dict(saved)
    assert torch.equal(env.state_dict()["sim"]["state"], before)


OF_THE_MACHINE: dict[str, Any] = {
    "seed": 8,
    "sim.num_threads": 1,
    "sim.engine": "native",
    "sim.njmax": 400,
    "sim.nan_guard.enabled": True,
    "viewer.width": 300,
}


@pytest.mark.parametrize("path", OF_THE_MACHINE)
def test_settings_of_the_machine_do_not_matter(make, path):
    saved = make().state_dict()
    make({path: OF_THE_MACHINE[path]}).load_state_dict(saved)


def test_curricula_are_no_other_settings(make):
    env = make()
    env.cfg.episode_length_s = 3.0
    env.command_manager.get_term("twist").ranges.lin_vel_x = (-3.0, 3.0)
    env.reward_manager.get_term_cfg("track_linear_velocity").weight = 7.0
    make().load_state_dict(env.state_dict())


def test_states_of_earlier_versions_are_restored(make):
    saved = make().state_dict()
    del saved["settings"]
    make({"decimation": 2}).load_state_dict(saved)


def test_copies_of_files_are_the_same_settings(tmp_path: Path):
    cfg, other = load_env_cfg(TRACKING), load_env_cfg(TRACKING)
    for number, one in enumerate((cfg, other)):
        path = tmp_path / f"{number}.npz"
        np.savez(path)
        motion: Any = one.commands["motion"]
        motion.motion_file = str(path)
    assert settings_of(cfg) == settings_of(other)
    assert settings_of(load_env_cfg(TRACKING)) == settings_of(load_env_cfg(TRACKING))
