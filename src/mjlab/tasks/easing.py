"""What makes a task easier while its learning begins, for `cpu` profiles, and what undoes it.

Each function edits a config in place, and returns what gives such a config, or a copy, back what it
had.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.envs import mdp as envs_mdp
from mjlab.managers.curriculum_manager import CurriculumTermCfg

Undo = Callable[[ManagerBasedRlEnvCfg], None]

_PUSH, _EASED_PUSH = "push_robot", "eased_push_robot"
_NUM_STAGES = 60


def ease_weight(env_cfg: ManagerBasedRlEnvCfg, name: str, first: float, steps: int) -> Undo:
    """Let the weight of a reward go from `first` to what it is, over so many environment steps."""
    term = env_cfg.rewards[name]
    if term is None:
        return lambda _: None
    last = term.weight
    stages = [
        {
            "step": stage * steps // _NUM_STAGES,
            "weight": first + (last - first) * stage / _NUM_STAGES,
        }
        for stage in range(_NUM_STAGES + 1)
    ]
    term.weight = first
    env_cfg.curriculum[f"eased_{name}"] = CurriculumTermCfg(
        func=envs_mdp.reward_curriculum, params={"reward_name": name, "stages": stages}
    )

    def undo(eased: ManagerBasedRlEnvCfg) -> None:
        eased_term = eased.rewards.get(name)
        if eased.curriculum.pop(f"eased_{name}", None) is not None and eased_term is not None:
            eased_term.weight = last

    return undo


def ease_pushes(env_cfg: ManagerBasedRlEnvCfg, steps: int) -> Undo:
    """Let the pushes of the event `push_robot` grow from nothing to what they are."""
    push = env_cfg.events.get(_PUSH)
    if push is not None:
        params = {"event_name": _PUSH, "velocity_range": push.params["velocity_range"]}
        params["steps"] = steps
        env_cfg.curriculum[_EASED_PUSH] = CurriculumTermCfg(func=growing_pushes, params=params)

    def undo(eased: ManagerBasedRlEnvCfg) -> None:
        pushed, growing = eased.events.get(_PUSH), eased.curriculum.pop(_EASED_PUSH, None)
        if pushed is not None and growing is not None:
            # Those of a training under way are as large as they have grown by then.
            pushed.params["velocity_range"] = growing.params["velocity_range"]

    return undo


def coarsen_physics(env_cfg: ManagerBasedRlEnvCfg) -> Undo:
    """Take half as many physics steps, of twice the length, for a step of the environment."""
    timestep, decimation = env_cfg.sim.mujoco.timestep, env_cfg.decimation
    env_cfg.sim.mujoco.timestep, env_cfg.decimation = 2.0 * timestep, decimation // 2

    def undo(eased: ManagerBasedRlEnvCfg) -> None:
        eased.sim.mujoco.timestep, eased.decimation = timestep, decimation

    return undo


def undo_all(undos: Sequence[Undo]) -> Undo:
    """Return what undoes all of these."""

    def undo(eased: ManagerBasedRlEnvCfg) -> None:
        for one in undos:
            one(eased)

    return undo


def growing_pushes(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | slice,
    event_name: str,
    velocity_range: dict[str, tuple[float, float]],
    steps: int,
) -> float:
    """Let pushes grow from nothing to `velocity_range` over `steps` environment steps.

    Returns the fraction that they have reached, for logging.
    """
    fraction = min(env.common_step_counter / steps, 1.0)
    params = env.event_manager.get_term_cfg(event_name).params
    params["velocity_range"] = part_of(velocity_range, fraction)
    return fraction


def part_of(
    ranges: dict[str, tuple[float, float]], fraction: float
) -> dict[str, tuple[float, float]]:
    """Return ranges that are a fraction as wide, by axis."""
    return {axis: (fraction * low, fraction * high) for axis, (low, high) in ranges.items()}
