"""Checks of vector environments against Gymnasium's interface.

Gymnasium's `check_env` is for single environments. `check_vector_env` supports any `VectorEnv`, not
only those of mjlab.
"""

from __future__ import annotations

import copy
from collections import defaultdict
from collections.abc import Iterator
from typing import Any, NoReturn

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, iterate

_FINAL = ("final_obs", "final_info")


class VectorEnvError(AssertionError):
    """Violation of Gymnasium's vector interface."""


def check_vector_env(
    env: VectorEnv, steps: int = 100, seed: int = 0, action_limit: float = 1.0
) -> None:
    """Check that `env` conforms to Gymnasium's vector interface.

    Resets and steps the environment with random actions, and checks spaces, shapes, types and bounds;
    that a seed determines the trajectory; that returned arrays are not modified; the ends of episodes, by
    the autoreset mode; and masks of infos.

    Args:
        env: Environment; it is not closed.
        steps: Number of steps; at least one episode must end in them.
        seed: Seed of the environment and of the actions.
        action_limit: Bound of random actions if the space is unbounded.

    Raises:
        VectorEnvError: the interface is violated; the message names the first fault.
        ValueError: no episode ended.
    """
    for name in ("observation_space", "action_space"):
        expected = batch_space(getattr(env, f"single_{name}"), env.num_envs)
        if (found := getattr(env, name)) != expected:
            _fail(env, name, f"expected batch_space(single_{name}, {env.num_envs}), got {found}")
    first = _Run(env, steps, seed, action_limit)
    if first.num_ends == 0:
        raise ValueError(
            f"No episode ended in {steps} steps, so resets were not checked; use more steps or shorter "
            "episodes."
        )
    second = _Run(env, steps, seed, action_limit)
    for step, (one, other) in enumerate(zip(first.returned, second.returned, strict=True)):
        if not _same(one, other):
            _fail(env, "seed", f"two runs with seed {seed} differ from step {step} on")


def _fail(env: VectorEnv, kind: str, text: str) -> NoReturn:
    raise VectorEnvError(f"{env} breaks Gymnasium's vector interface:\n- {kind}: {text}")


class _Run:
    """Run of an environment from a seed, which checks each result."""

    def __init__(self, env: VectorEnv, steps: int, seed: int, limit: float) -> None:
        """Reset and step `env`; keep copies of all results in `returned`."""
        self.env, self.num_ends = env, 0
        # True for each end with equal observations, by kind: terminations and time-outs.
        self._stale: dict[bool, list[bool]] = defaultdict(list)
        self._unreset: dict[bool, list[bool]] = defaultdict(list)
        self._still = False
        self._mode = env.metadata.get("autoreset_mode")
        if not isinstance(self._mode, AutoresetMode):
            self._fail(
                "autoreset_mode",
                f"expected metadata['autoreset_mode'] of {list(AutoresetMode)}, got {self._mode!r}",
            )
        actions = env.action_space
        if isinstance(actions, gymnasium.spaces.Box):
            # Samples of unbounded spaces are too large for a robot.
            low, high = (
                np.clip(end, actions.low, actions.high).astype(actions.dtype)
                for end in (-limit, limit)
            )
            actions = gymnasium.spaces.Box(low, high, dtype=actions.dtype)
        actions.seed(seed)
        self.returned = [self._reset(seed=seed)]
        for _ in range(steps):
            if self._mode is AutoresetMode.DISABLED and self._ended.any():
                self._reset_ended()
            self.returned.append(self._step(actions.sample()))
        # Equal observations are faults only if observations change from step to step.
        if any(map(all, self._stale.values())) and not self._still:
            self._fail("stale final_obs", "it is the observation before the last step")
        if any(map(all, self._unreset.values())) and not self._still:
            self._fail("reset", "observations after an end are those before the reset")

    def _fail(self, kind: str, text: str) -> NoReturn:
        _fail(self.env, kind, text)

    def _reset(self, **kwargs: Any) -> Any:
        """Reset, check the results, and return a copy of the observations."""
        result = self.env.reset(**kwargs)
        if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict)):
            self._fail("reset", f"expected (observations, infos), got {_kind(result)}")
        self._check_value(self.env.observation_space, result[0], "observations")
        self._check_masks(result[1])
        # First four results of the last step, copies of them, and mask of ended episodes.
        self._last = result[:1]
        self._copies = copy.deepcopy(self._last)
        self._ended = np.zeros(self.env.num_envs, dtype=bool)
        return self._copies[0]

    def _reset_ended(self) -> None:
        """Reset environments with ended episodes, and check that only their observations change."""
        ended, before = self._ended, self._rows(self._copies[0])
        self._reset(options={"reset_mask": ended.copy()})
        for row, after in enumerate(self._rows(self._copies[0])):
            same = _same(before[row], after)
            if ended[row]:
                self._unreset[True].append(same)
            elif not same:
                self._fail(
                    "reset_mask",
                    "expected resets only of environments with a true mask, got one with a false mask",
                )

    def _step(self, action: Any) -> Any:
        """Step, check the results, and return copies of the first four."""
        result = self.env.step(action)
        if not (isinstance(result, tuple) and len(result) == 5 and isinstance(result[4], dict)):
            self._fail("step", f"expected five results, the last a dict, got {_kind(result)}")
        if not _same(self._last, self._copies):
            self._fail("aliasing", "the next step modifies returned arrays; return copies")
        observations, rewards, terminated, truncated, infos = result
        self._check_value(self.env.observation_space, observations, "observations")
        for name, value, kind in (
            ("rewards", rewards, "f"),
            ("terminations", terminated, "b"),
            ("truncations", truncated, "b"),
        ):
            self._check_array(name, value, kind)
        self._check_masks(infos)
        before, ended_before = self._rows(self._copies[0]), self._ended
        self._last = result[:4]
        self._copies = copy.deepcopy(self._last)
        after = self._rows(self._copies[0])
        rewards, terminated, truncated = map(_array, self._copies[1:])
        self._ended = ended = terminated | truncated
        self.num_ends += int(ended.sum())
        untouched = np.flatnonzero(~(ended | ended_before))
        self._still |= any(_same(before[row], after[row]) for row in untouched)
        if self._mode is AutoresetMode.SAME_STEP:
            self._check_final(infos, ended, terminated, before, after)
        elif "final_obs" in infos:
            self._fail("final_obs", f"expected none with {self._mode}, got infos['final_obs']")
        if self._mode is AutoresetMode.NEXT_STEP:
            # The step after the end of an episode only resets.
            if (rewards[ended_before] != 0).any():
                self._fail(
                    "autoreset", "expected reward 0 in the step after an end, which only resets"
                )
            if (ended & ended_before).any():
                self._fail("autoreset", "an episode ends in the step that only resets")
        return self._copies

    def _rows(self, observations: Any) -> list[Any]:
        """Return the observation of each environment."""
        return list(iterate(self.env.observation_space, observations))

    def _check_value(self, space: gymnasium.Space, value: Any, name: str) -> None:
        for text in _mismatches(space, value, name):
            self._fail(name, text)

    def _check_array(self, name: str, value: Any, kind: str) -> None:
        shape, expected = (self.env.num_envs,), "floats" if kind == "f" else "bool"
        if not isinstance(value, np.ndarray | torch.Tensor):
            self._fail(name, f"expected an array {shape} of {expected}, got {_kind(value)}")
        array = _array(value)
        if array.shape != shape or array.dtype.kind != kind:
            self._fail(name, f"expected {shape} of {expected}, got {array.shape} of {array.dtype}")
        if kind == "f" and not np.isfinite(array).all():
            self._fail(name, "expected finite numbers")

    def _check_masks(self, infos: dict[str, Any], path: str = "infos") -> None:
        """Check that each entry has a mask, and one value per environment.

        Nested entries may share the mask of their parent, as in Gymnasium's wrappers.
        """
        for name, value in infos.items():
            if name.startswith("_"):
                continue
            mask = infos.get(f"_{name}")
            entry = f"{path}[{name!r}]"
            if (mask is not None or path == "infos") and not (
                isinstance(mask, np.ndarray | torch.Tensor)
                and tuple(mask.shape) == (self.env.num_envs,)
                and _array(mask).dtype == np.bool_
            ):
                self._fail(
                    "infos", f"expected a mask ({self.env.num_envs},) bool '_{name}' of {entry}"
                )
            if isinstance(value, dict):
                self._check_masks(value, entry)
            elif len(getattr(value, "shape", ())) < 1 or value.shape[0] != self.env.num_envs:
                self._fail("infos", f"expected an array of {self.env.num_envs} values in {entry}")

    def _check_final(
        self,
        infos: dict[str, Any],
        ended: np.ndarray,
        terminated: np.ndarray,
        before: list[Any],
        after: list[Any],
    ) -> None:
        """Check the final observations and infos of a step that ends and resets episodes."""
        for name in _FINAL:
            mask = infos.get(f"_{name}")
            shown = np.zeros_like(ended) if mask is None else _array(mask)
            if not np.array_equal(shown, ended):
                self._fail(
                    name,
                    f"expected infos['_{name}'] to be true for ended episodes "
                    f"({np.flatnonzero(ended).tolist()}), got {np.flatnonzero(shown).tolist()}",
                )
        if not ended.any():
            return
        final = infos["final_obs"]
        if not (isinstance(final, np.ndarray) and final.dtype == object):
            self._fail("final_obs", f"expected an object array, got {_kind(final)}")
        if any(final[row] is not None for row in np.flatnonzero(~ended)):
            self._fail("final_obs", "expected None for episodes that did not end")
        for row in np.flatnonzero(ended):
            self._check_value(self.env.single_observation_space, final[row], "final_obs")
            self._stale[bool(terminated[row])].append(_same(final[row], before[row]))
            self._unreset[bool(terminated[row])].append(_same(final[row], after[row]))


def _mismatches(space: gymnasium.Space, value: Any, name: str) -> Iterator[str]:
    """Yield a message for each mismatch between `value` and `space`."""
    if isinstance(space, gymnasium.spaces.Dict):
        if not isinstance(value, dict) or set(value) != set(space):
            found = sorted(value) if isinstance(value, dict) else _kind(value)
            yield f"{name}: expected a dict of {sorted(space)}, got {found}"
            return
        for key, inner in space.items():
            yield from _mismatches(inner, value[key], f"{name}[{key!r}]")
        return
    if isinstance(value, torch.Tensor):
        value = _array(value)
    if not isinstance(value, np.ndarray) and space.shape:
        yield f"{name}: expected an array {space.shape}, got {_kind(value)}"
    elif isinstance(value, np.ndarray) and (value.shape, value.dtype) != (space.shape, space.dtype):
        yield (
            f"{name}: expected {space.shape} of {space.dtype}, got {value.shape} of {value.dtype}"
        )
    elif isinstance(value, np.ndarray) and value.dtype.kind == "f" and not np.isfinite(value).all():
        yield f"{name}: expected finite numbers"
    elif not space.contains(value):
        yield f"{name}: values are outside the bounds of the space"


def _array(value: Any) -> np.ndarray:
    return value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return all(_same(one[name], other[name]) for name in one)
    if isinstance(one, tuple):
        return all(map(_same, one, other))
    return np.array_equal(_array(one), _array(other), equal_nan=_array(one).dtype.kind == "f")


def _kind(value: Any) -> str:
    if isinstance(value, tuple):
        return f"a tuple of {len(value)}"
    return f"a {type(value).__name__}"
