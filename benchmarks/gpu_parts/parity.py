"""Parity of observations and rewards on both engines, from the same states.

Native MuJoCo on the CPU is the reference: before every step Warp takes over its state, and both step
with the same actions. So chaotic motions with contacts do not diverge, and every
step is a separate comparison. An error is relative to the largest value of its quantity.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from measure import Row

from gpu_parts.options import Options
from gpu_parts.tasks import (
    CARTPOLE,
    GO1_FLAT,
    LIFT_CUBE,
    TRACKING,
    close,
    make_env,
    random_actions,
)
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg

STATE_TOLERANCE = 5e-3
"""Error of observations of the same state. Contact forces (critic) are the least exact."""
STEP_TOLERANCE = 2e-2
"""Error of observations and rewards after one step, in double and in single precision."""
WITHIN = 0.99
"""Share of the environments' steps within these tolerances: a contact that begins in this substep on
one engine and in the next on the other exceeds them."""

_STATE = (
    *("time", "qpos", "qvel", "act", "ctrl", "qfrc_applied", "xfrc_applied"),
    *("eq_active", "mocap_pos", "mocap_quat", "qacc_warmstart"),
)


@dataclass
class _Errors:
    """Relative errors of all environments in all steps, and the location of the largest."""

    values: list[torch.Tensor] = field(default_factory=list)
    largest: float = 0.0
    place: str = "nowhere"

    def add(self, name: str, native: torch.Tensor, warp: torch.Tensor) -> torch.Tensor:
        """Return the error of each environment (N,) in `name`, whose values are (N, ...)."""
        native, warp = native.cpu().float().flatten(1), warp.cpu().float().flatten(1)
        scale = 1.0 + native.abs().amax(dim=0)
        # NaN on one engine alone is an infinite error.
        errors = ((native - warp).abs() / scale).nan_to_num(nan=torch.inf).amax(dim=1)
        if errors.max() > self.largest:
            self.largest, self.place = float(errors.max()), name
        return errors

    def share_within(self, tolerance: float) -> float:
        """Return the share of errors up to `tolerance`."""
        return (torch.cat(self.values) <= tolerance).float().mean().item()

    def row(self, what: str, compared_with: str, tolerance: float, also: bool = True) -> Row:
        """Return the line of the table; `also` is a further condition."""
        values = torch.cat(self.values)
        share = self.share_within(tolerance)
        middle, high = values.quantile(torch.tensor([0.5, 0.99])).tolist()
        return Row(
            what,
            f"{share:.2%} within {tolerance:g}; median {middle:.1e}, 99 % {high:.1e}, largest "
            f"{self.largest:.1e} ({self.place})",
            compared_with,
            f"{WITHIN:.0%} within {tolerance:g}",
            share >= WITHIN and also,
        )


def measure(options: Options) -> Iterator[Row]:
    """Compare one task of each family; yield two rows per task."""
    num_envs, steps = options.sized((128, 40), (4, 2))
    for task in options.sized((CARTPOLE, GO1_FLAT, LIFT_CUBE, TRACKING), (CARTPOLE, GO1_FLAT)):
        native, warp = both(task, num_envs, options.device)
        yield from compare(task, native, warp, steps)
        for env in (native, warp):
            close(env)


def both(task: str, num_envs: int, device: str) -> tuple[ManagerBasedRlEnv, ManagerBasedRlEnv]:
    """Return the task on native MuJoCo, and on Warp on `device`."""
    native = make_env(task, num_envs, "cpu", "native", _without_chance)
    return native, make_env(task, num_envs, device, "warp", _without_chance)


def _without_chance(cfg: ManagerBasedRlEnvCfg) -> None:
    """Remove terms that draw random numbers within a step: the devices draw different ones."""
    for group in cfg.observations.values():
        group.enable_corruption = False
    kept = {n: event for n, event in cfg.events.items() if event.mode not in ("interval", "step")}
    cfg.events = kept


def compare(
    task: str, native: ManagerBasedRlEnv, warp: ManagerBasedRlEnv, steps: int
) -> Iterator[Row]:
    """Run `steps` steps, each from the same states; return two rows."""
    generator = torch.Generator().manual_seed(0)
    seen, stepped = _Errors(), _Errors()
    ended_differently, count = 0, 0
    for _ in range(steps):
        follow(native, warp)
        seen.values.append(_observed(seen, native, warp))
        actions = random_actions(native, generator)
        ended = [env.step(actions.to(env.device))[2:4] for env in (native, warp)]
        done = [(terminated | truncated).cpu() for terminated, truncated in ended]
        # Finished episodes restart at random states.
        going = ~(done[0] | done[1])
        errors = _observed(stepped, native, warp, going)
        rewards = [env.reward_manager._step_reward[going.to(env.device)] for env in (native, warp)]
        for index, name in enumerate(native.reward_manager.active_terms):
            both = (values[:, index : index + 1] for values in rewards)
            errors = torch.maximum(errors, stepped.add(f"reward {name}", *both))
        stepped.values.append(errors)
        ended_differently += int((done[0] != done[1]).sum())
        count += native.num_envs
    yield seen.row(
        f"{task}: observations of {count} equal states, error of Warp",
        "native MuJoCo",
        STATE_TOLERANCE,
    )
    yield stepped.row(
        f"{task}: observations and rewards after one step from them, error of Warp",
        f"native MuJoCo; {ended_differently} episodes ended on one engine alone",
        STEP_TOLERANCE,
        also=ended_differently <= (1 - WITHIN) * count,
    )


def _observed(
    errors: _Errors,
    native: ManagerBasedRlEnv,
    warp: ManagerBasedRlEnv,
    rows: torch.Tensor | None = None,
) -> torch.Tensor:
    """Return the largest error (N,) over all observation groups, in `rows` (None: all)."""
    largest = torch.zeros(native.num_envs if rows is None else int(rows.sum()))
    for name, values in native.obs_buf.items():
        pair: list[Any] = [values, warp.obs_buf[name]]
        if not all(isinstance(value, torch.Tensor) for value in pair):
            raise TypeError(f"observation group {name!r}: expected one tensor, got several")
        of_native, of_warp = (v if rows is None else v[rows.to(v.device)] for v in pair)
        largest = torch.maximum(largest, errors.add(name, of_native, of_warp))
    return largest


def follow(native: ManagerBasedRlEnv, warp: ManagerBasedRlEnv) -> None:
    """Copy the state of the environments on native MuJoCo to those on Warp."""
    state: dict[str, Any] = native.state_dict()
    # Saved physics states do not transfer between engines; copy the fields.
    state["sim"] = warp.sim.state_dict()
    warp.load_state_dict(state)
    for name in native.sim.expanded_fields & warp.sim.expanded_fields:
        getattr(warp.sim.model, name).copy_(getattr(native.sim.model, name))
    for name in _STATE:
        getattr(warp.sim.data, name).copy_(getattr(native.sim.data, name))
    for env in (native, warp):
        env.sim.forward()
        env.sim.sense()
        # Recompute: the copied state includes old observations.
        env.obs_buf = env.observation_manager.compute(update_history=True)
