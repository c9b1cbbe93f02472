"""Golden trace: what the training environment measures, observes, answers and does, step by step.

`docs/reference/contract.md` describes the arrays. A program that runs the policy elsewhere must give the
same answers to the same measurements.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Mapping
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch

from mjlab.deploy.contract import joint_factors
from mjlab.envs.mdp.actions import RelativeJointPositionAction

if TYPE_CHECKING:
    from pathlib import Path

    from mjlab.deploy.contract import Contract

EPISODE_STEPS = 100
"""Number of steps of an episode of the trace."""
STATE = ("qpos", "qvel", "act", "qacc_warmstart", "mocap_pos", "mocap_quat")
"""Fields of `MjData` that are the state."""
# Sizes above this are images: too wide for a table.
_WIDEST = 1000


def record(contract: Contract, policy: Any, steps: int) -> tuple[dict[str, np.ndarray], list]:
    """Play `steps` control steps; return the arrays of the trace and its episodes.

    Args:
        contract: Contract of the policy in a nominal environment.
        policy: Function of the observations of the environment, with `reset`, such as `OnnxPolicy`.
        steps: Number of control steps K.
    """
    env = contract.subject.env
    clip, episodes, is_over = contract.nominal.action_clip, [], False
    with env.curricula_held(), torch.no_grad(), _values_kept(contract) as values:
        recorder = _Recorder(contract, values)
        for k in range(steps):
            if not episodes or k - episodes[-1]["row"] == EPISODE_STEPS or is_over:
                # Seeded, because building the policy may have drawn random numbers.
                observations, _ = env.reset(seed=None if episodes else env.cfg.seed)
                policy.reset()
                episodes.append({"row": k, "motion": _motion(env)})
            recorder.before(k, observations, is_first=episodes[-1]["row"] == k)
            action = policy(observations)
            if clip is not None:
                action = action.clamp(-clip, clip)
            observations, _, terminated, truncated, _ = env.step(action)
            recorder.after()
            is_over = bool((terminated | truncated).any())
    return recorder.arrays(), episodes


@contextlib.contextmanager
def _values_kept(contract: Contract) -> Generator[dict[int, torch.Tensor]]:
    """Keep the last value of each observation function, by id of the term's config.

    A second call would advance a function with state, such as a filter.
    """
    values: dict[int, torch.Tensor] = {}
    manager = contract.subject.env.observation_manager
    names = {group for groups in contract.groups.values() for group in groups}
    cfgs = [manager.get_term_cfg(g, term) for g in names for term in manager.active_terms[g]]
    functions = {id(cfg): (cfg, cfg.func) for cfg in cfgs}

    def kept(key: int, func: Callable[..., torch.Tensor]) -> Callable[..., torch.Tensor]:
        def call(env: Any, **params: Any) -> torch.Tensor:
            value = func(env, **params)
            # It may be a view of simulation memory.
            values[key] = value.clone()
            return value

        return call

    try:
        for key, (cfg, func) in functions.items():
            cfg.func = kept(key, func)
        yield values
    finally:
        for cfg, func in functions.values():
            cfg.func = func


def _motion(env: Any) -> int:
    """Return the index of the motion played; 0 without motions."""
    terms = (env.command_manager.get_term(name) for name in env.command_manager.active_terms)
    return next((int(t.motion_ids[0]) for t in terms if hasattr(t, "motion_ids")), 0)


class _Recorder:
    """Rows of the trace."""

    def __init__(self, contract: Contract, values: Mapping[int, torch.Tensor]) -> None:
        self._contract, self._values = contract, values
        self._env = contract.subject.env
        self._host = mujoco.MjData(contract.subject.model)
        self._rows: dict[str, list[np.ndarray]] = {}
        # Fields read for the first time after a step would be one substep newer.
        self._outputs = {
            name: getattr(self._env.sim.data, name) for name in ("ctrl", "actuator_force")
        }

    def before(self, k: int, observations: Mapping[str, Any], is_first: bool) -> None:
        """Record state, measurements, commands and observations."""
        env, contract = self._env, self._contract
        self._add("first", np.array(is_first))
        self._add("time", np.array(k * env.step_dt))
        self._state("state")
        for name, measurement in contract.measurements.items():
            if measurement.read is None:
                value = self._values[id(measurement.term)]
            else:
                value = measurement.read(env)
            self._add(f"measurement/{name}", _row(value))
        for name in env.command_manager.active_terms:
            term: Any = env.command_manager.get_term(name)
            self._add(f"command/{name}", _row(term.command))
        for name, groups in contract.groups.items():
            parts = [observations[group] for group in groups]
            self._add(f"input/{name}", _row(torch.cat(parts, dim=-1) if parts[1:] else parts[0]))
            self._terms(name, groups, observations)

    def _terms(self, name: str, groups: list[str], observations: Mapping[str, Any]) -> None:
        manager = self._env.observation_manager
        for group in groups:
            values = self._split(group, observations[group])
            for term in manager.active_terms[group]:
                raw = self._values[id(manager.get_term_cfg(group, term))]
                self._add(f"raw/{name}/{term}", _row(raw.float()))
                self._add(f"term/{name}/{term}", _row(values[term]))

    def _split(self, group: str, observation: Any) -> dict[str, torch.Tensor]:
        """Return the values of the terms of a group."""
        if isinstance(observation, dict):
            return observation
        manager = self._env.observation_manager
        cfg = manager.cfg[group]
        dim = -1 if cfg is None else cfg.concatenate_dim
        sizes = [shape[dim] for shape in manager.group_obs_term_dim[group]]
        parts = observation.split(sizes, dim=dim + 1 if dim >= 0 else dim)
        return dict(zip(manager.active_terms[group], parts, strict=True))

    def after(self) -> None:
        """Record action, targets, controls and the state reached."""
        env = self._env
        self._add("action", _row(env.action_manager.action))
        terms: list[Any] = [
            env.action_manager.get_term(name) for name in env.action_manager.active_terms
        ]
        self._add("target", _row(torch.cat([_targets(env, term) for term in terms], dim=1)))
        for name, value in self._outputs.items():
            self._add(name, _row(value))
        self._state("after")

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays, (K, ...)."""
        return {name: np.stack(rows) for name, rows in self._rows.items()}

    def _state(self, prefix: str) -> None:
        self._env.sim.copy_to_host(0, self._host)
        for name in STATE:
            self._add(f"{prefix}/{name}", np.array(getattr(self._host, name)))

    def _add(self, name: str, value: np.ndarray) -> None:
        self._rows.setdefault(name, []).append(value)


def _targets(env: Any, term: Any) -> torch.Tensor:
    """Return the targets of an action, at the joints, (N, T)."""
    targets: torch.Tensor = getattr(term, "_processed_actions", term.raw_action)
    if isinstance(term, RelativeJointPositionAction):
        targets = targets + term.measured
    factors = joint_factors(env, term)
    # An action of another package may have targets of its own.
    is_of_joints = len(factors) == targets.shape[1]
    return targets * targets.new_tensor(factors) if is_of_joints else targets


def _row(value: torch.Tensor) -> np.ndarray:
    """Return a copy of the values of the only environment."""
    return value[0].detach().cpu().numpy().copy()


def write_csv(path: Path, contract: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write the trace as a table: raw measurements and commands in, answers out."""
    columns: dict[str, np.ndarray] = {
        "step": np.arange(len(arrays["time"])),
        "first": arrays["first"].astype(int),
        "time": arrays["time"],
    }
    joints = [joint["name"] for joint in contract["joints"]]
    targets = [joint for action in contract["actions"] for joint in action["joints"]]
    named = {"measurement/joint_pos": joints, "measurement/joint_vel": joints, "target": targets}
    for name, values in arrays.items():
        shown = "obs" if name == "input/obs" else name
        kept = shown in ("obs", "action", "target") or name.startswith(("measurement/", "command/"))
        flat = values.reshape(len(values), -1)
        if not kept or flat.shape[1] > _WIDEST:
            continue
        labels = named.get(name, range(flat.shape[1]))
        for k, label in enumerate(labels):
            # Names of measurements may contain a slash.
            columns[f"{shown.replace('/', '.', 1)}.{label}"] = flat[:, k]
    # Nine digits: float32 reads back as the same number.
    lines = [",".join(columns)]
    lines += [
        ",".join(f"{value:.9g}" for value in row) for row in zip(*columns.values(), strict=True)
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
