"""Broken physics in training on both engines: must be reported, and must not look like success."""

from __future__ import annotations

import importlib.util
import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .commands import SMALL, TASK, check_end, command
from .runs import check_loadable, checkpoints, learned
from .trials import Broken, Trial

WHAT = (
    "time steps, gains, actions, states, rewards and models that break the physics, on both engines"
)
TRIALS = 51
LIMIT = 600.0

_BROKEN_TASK = "Torture-Cartpole"
_ITERATIONS = 4
_PATIENCE = 400.0
_TOLD = re.compile(r"diverg|unstable|\bnan\b|not finite|infinit|\binf\b|bad state|too large", re.I)
# Limit of plausible values of a cartpole run.
_SANE = 1e8

Edit = Callable[[Any, random.Random], str]


def preload() -> None:
    """Import Warp if installed."""
    if _has_warp():
        importlib.import_module("mjlab.sim.warp.engine")


def prepare(folder: Path) -> None:
    """Compile Warp's kernels once, in minutes on a new machine."""
    if _has_warp():
        engine = ("--engine", "warp", "--agent.max-iterations", "1")
        ended = command("train", TASK, *SMALL, *engine, patience=_PATIENCE)
        if ended.status != 0:
            raise RuntimeError(ended.said)


def _has_warp() -> bool:
    return importlib.util.find_spec("mujoco_warp") is not None


def run(trial: Trial, prepared: Any) -> None:
    """Train a cartpole that one edit has broken."""
    edit = _EDITS[trial.number % len(_EDITS)]
    turn, salt = trial.number // len(_EDITS), trial.rng.getrandbits(32)
    engine = "warp" if _has_warp() and turn % 2 else "native"

    def register() -> None:
        from mjlab.tasks.registry import register_mjlab_task

        register_mjlab_task(
            _BROKEN_TASK,
            lambda: _edited(edit, random.Random(salt)),
            rl_cfg="mjlab.tasks.cartpole.cartpole_env_cfg:cartpole_ppo_runner_cfg",
        )

    how = edit(_cfg(), random.Random(salt))
    trial.trying(f"{how}, {engine}")
    flags = ("--engine", engine, "--log-root", "logs", "--agent.max-iterations", str(_ITERATIONS))
    argv = (_BROKEN_TASK, *SMALL, *flags)
    ended = command("train", *argv, before=register, patience=_PATIENCE)
    check_end(ended)
    if any(Path().glob("**/MUJOCO_LOG.TXT")):
        raise Broken("MUJOCO_LOG.TXT in the working folder")
    check_loadable(Path("logs"))
    lines = ended.said.splitlines()
    if ended.status == 0 and not any(_TOLD.search(line) for line in lines):
        if edit in _CERTAIN:
            raise Broken("exit status 0, and the divergence is not told")
        _check_sane(Path("logs"))


def _check_sane(root: Path) -> None:
    """Raise Broken if values or weights of a run without a report are absurd."""
    import torch
    from torch.utils._pytree import tree_leaves

    from mjlab.rl.plot import read_all_scalars

    newest = checkpoints(root)[-1]
    for tag, (_, values) in read_all_scalars(newest.parent).items():
        for value in values:
            if not abs(value) < _SANE and not tag.startswith("Perf"):
                raise Broken(f"exit status 0, and {tag} is {value:.3g}")
    for value in tree_leaves(learned(newest)):
        if (
            isinstance(value, torch.Tensor)
            and value.is_floating_point()
            and not value.isfinite().all()
        ):
            raise Broken("exit status 0, and weights are not finite")


def _cfg() -> Any:
    from mjlab.tasks.registry import load_env_cfg

    return load_env_cfg(TASK)


def _edited(edit: Edit, rng: random.Random) -> Any:
    cfg = _cfg()
    edit(cfg, rng)
    return cfg


# Edits of the task's config. Each returns a description.


def _long_step(cfg: Any, rng: random.Random) -> str:
    cfg.sim.mujoco.timestep = 100.0
    cfg.episode_length_s = 50_000.0
    return "time step of 100 s"


def _longish_step(cfg: Any, rng: random.Random) -> str:
    cfg.sim.mujoco.timestep = rng.choice((0.2, 1.0, 5.0))
    cfg.episode_length_s = 1000 * cfg.sim.mujoco.timestep
    return f"time step of {cfg.sim.mujoco.timestep} s"


def _gravity(cfg: Any, rng: random.Random) -> str:
    value = rng.choice((1e12, 1e30, float("nan"), float("inf")))
    cfg.sim.mujoco.gravity = (0.0, 0.0, -value)
    return f"gravity of {value:g} m/s^2"


def _action_scale(cfg: Any, rng: random.Random) -> str:
    # Infinite actions are clipped to the motor's range.
    cfg.actions["effort"].scale = float("nan")
    return "actions scaled by nan"


def _with_spec(cfg: Any, change: Callable[[Any], None]) -> None:
    """Change the robot's spec after loading."""
    entity = cfg.scene.entities["cartpole"]
    read = entity.spec_fn

    def spec() -> Any:
        made = read()
        change(made)
        return made

    entity.spec_fn = spec


def _stiff(cfg: Any, rng: random.Random) -> str:
    gain = rng.choice((1e7, 1e10, 1e15))

    def change(spec: Any) -> None:
        (motor,) = spec.actuators
        motor.gainprm[0], motor.biasprm[1], motor.biasprm[2] = gain, -gain, -gain / 1000
        motor.biastype, motor.ctrllimited, motor.forcelimited = 1, 0, 0

    _with_spec(cfg, change)
    # Otherwise damping is implicit, and stable.
    cfg.sim.mujoco.integrator = "euler"
    return f"servo with a gain of {gain:g}"


def _negative_damping(cfg: Any, rng: random.Random) -> str:
    value = rng.choice((-10.0, -1000.0))

    def change(spec: Any) -> None:
        import numpy as np

        for joint in spec.joints:
            joint.damping = np.full_like(joint.damping, value)

    _with_spec(cfg, change)
    return f"damping of {value:g}"


def _massless(cfg: Any, rng: random.Random) -> str:
    def change(spec: Any) -> None:
        for geom in spec.geoms:
            geom.mass = 0.0

    _with_spec(cfg, change)
    return "bodies without mass"


def _nan_mass(cfg: Any, rng: random.Random) -> str:
    value = rng.choice((float("nan"), float("inf"), -1.0, 1e-300, 1e300))

    def change(spec: Any) -> None:
        for geom in spec.geoms:
            geom.mass = value

    _with_spec(cfg, change)
    return f"bodies of {value:g} kg"


def _add_event(cfg: Any, func: Callable[..., None], mode: Any) -> None:
    from mjlab.managers import EventTermCfg

    every = (0.3, 0.3) if mode == "interval" else None
    cfg.events["breaks"] = EventTermCfg(func=func, mode=mode, interval_range_s=every)


def _state_event(cfg: Any, rng: random.Random) -> str:
    name = rng.choice(("qpos", "qvel", "qfrc_applied", "xfrc_applied"))
    value = rng.choice((float("nan"), float("inf"), 1e15, 1e30))
    mode = rng.choice(("interval", "reset"))

    def breaks(env: Any, env_ids: Any) -> None:
        getattr(env.sim.data, name)[env_ids] = value

    _add_event(cfg, breaks, mode)
    return f"event ({mode}) that sets {name} to {value:g}"


def _rarely(cfg: Any, rng: random.Random) -> str:
    value = rng.choice((float("nan"), 1e20))

    def breaks(env: Any, env_ids: Any) -> None:
        env.sim.data.qvel[0] = value

    _add_event(cfg, breaks, "interval")
    return f"event that sets qvel of one environment to {value:g}"


def _add_reward(cfg: Any, func: Callable[..., Any]) -> None:
    from mjlab.managers import RewardTermCfg

    cfg.rewards["breaks"] = RewardTermCfg(func=func, weight=1.0)


def _reward(cfg: Any, rng: random.Random) -> str:
    value = rng.choice((float("nan"), float("inf"), -float("inf")))

    def reward(env: Any) -> Any:
        import torch

        return torch.full((env.num_envs,), value)

    _add_reward(cfg, reward)
    return f"reward of {value:g}"


def _reward_of_one(cfg: Any, rng: random.Random) -> str:
    value = rng.choice((float("nan"), float("inf"), 1e30))

    def reward(env: Any) -> Any:
        import torch

        values = torch.zeros(env.num_envs)
        values[0] = value
        return values

    _add_reward(cfg, reward)
    return f"reward of {value:g} in one environment"


def _odd_reward(cfg: Any, rng: random.Random) -> str:
    kind = rng.choice(("complex", "meta", "text", "none", "column"))

    def reward(env: Any) -> Any:
        import torch

        return {
            "complex": torch.ones(env.num_envs, dtype=torch.complex64),
            "meta": torch.ones(env.num_envs, device="meta"),
            "text": "text",
            "none": None,
            "column": torch.ones(env.num_envs, 1),
        }[kind]

    _add_reward(cfg, reward)
    return f"reward that is {kind}"


def _termination(cfg: Any, rng: random.Random) -> str:
    from mjlab.managers import TerminationTermCfg

    value = rng.choice((float("nan"), 0.5))

    def termination(env: Any) -> Any:
        import torch

        return torch.full((env.num_envs,), value)

    cfg.terminations["breaks"] = TerminationTermCfg(func=termination)
    return f"termination of {value:g}"


def _observation(cfg: Any, rng: random.Random) -> str:
    from mjlab.managers import ObservationTermCfg

    value = rng.choice((float("nan"), float("inf"), 1e38))

    def observation(env: Any) -> Any:
        import torch

        return torch.full((env.num_envs, 1), value)

    cfg.observations["actor"].terms["breaks"] = ObservationTermCfg(func=observation)
    return f"observation of {value:g}"


_EDITS: tuple[Edit, ...] = (
    _long_step, _gravity, _action_scale, _stiff, _state_event, _reward, _termination, _observation,
    _negative_damping, _massless, _nan_mass, _longish_step, _rarely, _reward_of_one, _odd_reward,
    _state_event, _stiff,
)  # fmt: skip
# Invalid edits.
_CERTAIN = (_long_step, _gravity, _action_scale, _reward, _termination, _state_event, _odd_reward)
