"""Replay buffer of the off-policy learner: the last steps of every environment."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from mjlab.rl.checkpoint import CheckpointError, read_checkpoint, save_checkpoint
from mjlab.utils.errors import check_count
from mjlab.utils.memory import check_memory

logger = logging.getLogger(__name__)

# Ends of environment steps: episode continues, terminated, timed out with a known final observation,
# or continued with an unknown observation.
_CONTINUES, _TERMINATED, _TIMED_OUT, _CUT_OFF = range(4)
# Steps per slot for final observations: time-outs are rare.
_STEPS_PER_TIME_OUT = 32


@dataclass
class Batch:
    """Transitions sampled from the replay buffer, each over one or more environment steps."""

    observations: TensorDict
    """Observation groups before the transition, (B, size)."""
    actions: torch.Tensor
    """Actions, (B, A)."""
    returns: torch.Tensor
    """Discounted sums of rewards, (B,)."""
    discounts: torch.Tensor
    """Discount of the value of `next_observations`, (B,); 0 for terminated episodes."""
    next_observations: TensorDict
    """Observation groups after the transition, (B, size)."""
    weights: torch.Tensor
    """Weight in the loss, (B,): 0 if the next observation is unknown, else 1."""


class ReplayStorage:
    """Ring buffer of the last `num_steps` steps of N environments.

    Each observation is stored once: the observation after a step is the one before the next step.
    Final observations of episodes that timed out are stored separately.

    All memory is allocated at construction; see `num_bytes`.
    """

    def __init__(
        self, num_steps: int, observations: TensorDict, groups: Sequence[str], num_actions: int
    ) -> None:
        """Allocate the buffer and store the first observations.

        Args:
            num_steps: Capacity, in steps per environment.
            observations: Observations of all environments, of batch size (N,).
            groups: Names of the groups to store.
            num_actions: Number of actions A.

        Raises:
            ValueError: `num_steps` is not positive, or the buffer exceeds the memory.
        """
        check_count("SAC replay_steps", num_steps)
        self._num_envs = len(observations)
        size = sum(observations[name].nbytes for name in groups)
        size += self._num_envs * (4 * num_actions + 13)
        device = str(observations[groups[0]].device)
        check_memory("SAC replay_steps", num_steps, size, device, "fewer steps or environments")
        self._num_steps = num_steps
        self._device = observations[groups[0]].device
        rows, envs = num_steps + 1, self._num_envs

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(shape, dtype=dtype, device=self._device)

        self._num_ends = max(rows * envs // _STEPS_PER_TIME_OUT, envs)
        shapes = {name: tuple(observations[name].shape[1:]) for name in groups}
        self._observations = {name: zeros(rows, envs, *shape) for name, shape in shapes.items()}
        self._ends = {name: zeros(self._num_ends, *shape) for name, shape in shapes.items()}
        self._actions = zeros(rows, envs, num_actions)
        self._rewards = zeros(rows, envs)
        self._kinds = zeros(rows, envs, dtype=torch.int8)
        # Number of the final observation of a step that timed out, among all ever stored.
        self._end_numbers = zeros(rows, envs, dtype=torch.int64)
        self._num_ends_stored = 0
        self._row = 0
        self._num_filled = 0
        self._put(observations)

    @property
    def num_filled(self) -> int:
        """Number of steps stored per environment."""
        return self._num_filled

    @property
    def num_bytes(self) -> int:
        """Size of all tensors, in bytes."""
        return sum(tensor.nbytes for tensor in self._tensors().values())

    def start(self, observations: TensorDict) -> None:
        """Set the observations before the next step, if they did not come from `add`.

        In environments with observations different from those after the last step, the result of
        the last step is marked as unknown.
        """
        if self._num_filled > 0:
            differs = torch.zeros(self._num_envs, dtype=torch.bool, device=self._device)
            for name, stored in self._observations.items():
                differs |= (stored[self._row] != observations[name]).flatten(1).any(dim=1)
            last = self._kinds[self._row - 1]
            last[differs & (last == _CONTINUES)] = _CUT_OFF
        self._put(observations)

    def add(
        self,
        actions: torch.Tensor,
        rewards: torch.Tensor,
        dones: torch.Tensor,
        time_outs: torch.Tensor | None,
        next_observations: TensorDict,
        final_ids: torch.Tensor | None = None,
        final_observations: TensorDict | None = None,
    ) -> None:
        """Store one step of all environments.

        Args:
            actions: Actions, (N, A).
            rewards: Rewards, (N,).
            dones: Nonzero if the episode ended, (N,).
            time_outs: True if the episode timed out, (N,). None: no time-outs.
            next_observations: Observations of the next action, after the reset of ended episodes.
            final_ids: Environments with a final observation, (k,).
            final_observations: Final observations, of batch size (k,).
        """
        row = self._row
        self._actions[row] = actions
        self._rewards[row] = rewards
        kinds = self._kinds[row]
        kinds[:] = dones.bool() * _TERMINATED
        if time_outs is not None:
            kinds[time_outs.bool()] = _CUT_OFF
        if final_ids is not None and final_observations is not None and len(final_ids) > 0:
            count = len(final_ids)
            numbers = torch.arange(count, device=self._device) + self._num_ends_stored
            for name, stored in self._ends.items():
                stored[numbers % self._num_ends] = final_observations[name]
            kinds[final_ids] = _TIMED_OUT
            self._end_numbers[row, final_ids] = numbers
            self._num_ends_stored += count
        self._row = (row + 1) % (self._num_steps + 1)
        self._num_filled = min(self._num_filled + 1, self._num_steps)
        self._put(next_observations)

    def sample(
        self, size: int, gamma: float, num_steps: int, generator: torch.Generator | None = None
    ) -> Batch:
        """Sample `size` transitions, each over `num_steps` steps or up to the end of the episode.

        `gamma` is the discount factor, `generator` the random number generator.
        """
        steps = min(num_steps, self._num_filled)
        starts = self._num_filled - steps + 1
        drawn = torch.randint(
            starts * self._num_envs, (size,), generator=generator, device=self._device
        )
        envs = drawn % self._num_envs
        # Steps are counted from the oldest step.
        oldest = self._row - self._num_filled
        first = (oldest + drawn // self._num_envs) % (self._num_steps + 1)
        kind = torch.zeros_like(drawn, dtype=torch.int8)
        returns = torch.zeros(size, device=self._device)
        discounts = torch.ones(size, device=self._device)
        last = first
        for step in range(steps):
            row = (first + step) % (self._num_steps + 1)
            runs = kind == _CONTINUES
            last = torch.where(runs, row, last)
            returns += torch.where(runs, discounts * self._rewards[row, envs], 0.0)
            discounts = torch.where(runs, discounts * gamma, discounts)
            kind = torch.where(runs, self._kinds[row, envs], kind)
        numbers = self._end_numbers[last, envs]
        timed_out = kind == _TIMED_OUT
        overwritten = timed_out & (numbers < self._num_ends_stored - self._num_ends)
        known = ~(overwritten | (kind == _CUT_OFF))
        after = (last + 1) % (self._num_steps + 1)
        chosen = timed_out.nonzero().flatten()
        ends = numbers[chosen] % self._num_ends
        observations, next_observations = {}, {}
        for name, stored in self._observations.items():
            observations[name] = stored[first, envs]
            next_observations[name] = stored[after, envs]
            next_observations[name][chosen] = self._ends[name][ends]
        return Batch(
            observations=TensorDict(observations, batch_size=[size]),
            actions=self._actions[first, envs],
            returns=returns,
            discounts=torch.where(kind == _TERMINATED, 0.0, discounts),
            next_observations=TensorDict(next_observations, batch_size=[size]),
            weights=known.float(),
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the contents; tensors are not copied."""
        return {
            "tensors": self._tensors(),
            "row": self._row,
            "num_filled": self._num_filled,
            "num_ends_stored": self._num_ends_stored,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the contents of `state_dict`.

        Raises:
            ValueError: the state is of different environments, observations or capacity. Nothing was
                changed.
        """
        self.check_fits(state)
        for name, tensor in self._tensors().items():
            tensor.copy_(state["tensors"][name])
        self._row = state["row"]
        self._num_filled = state["num_filled"]
        self._num_ends_stored = state["num_ends_stored"]

    def check_fits(self, state: Mapping[str, Any]) -> None:
        """Raise ValueError if `state` is of different environments, observations or capacity."""
        expected, found = (
            {name: tuple(tensor.shape) for name, tensor in tensors.items()}
            for tensors in (self._tensors(), state["tensors"])
        )
        if expected != found:
            raise ValueError(f"Replay tensors: expected {expected}, got {found}.")

    def _put(self, observations: TensorDict) -> None:
        for name, stored in self._observations.items():
            stored[self._row] = observations[name]

    def _tensors(self) -> dict[str, torch.Tensor]:
        return {
            "actions": self._actions,
            "rewards": self._rewards,
            "kinds": self._kinds,
            "end_numbers": self._end_numbers,
            **{f"observations/{name}": value for name, value in self._observations.items()},
            **{f"ends/{name}": value for name, value in self._ends.items()},
        }


class ReplayFiles:
    """Replay file of a checkpoint: `replay_model_100.pt` next to `model_100.pt`.

    The file is separate because it is a thousand times as large as the networks; only the newest
    checkpoint of a folder has one. File and checkpoint carry the same `identity`.
    """

    def __init__(self, checkpoint: str | os.PathLike[str]) -> None:
        """Set the path for `checkpoint`."""
        path = Path(checkpoint)
        self.path = path.with_name(f"replay_{path.name}")
        """Path of the replay file."""

    def write(self, storage: ReplayStorage, identity: str | None = None) -> None:
        """Write the contents of `storage`, for the checkpoint with `identity`.

        Raises:
            CheckpointError: the file could not be written.
        """
        save_checkpoint({**storage.state_dict(), "identity": identity}, self.path)

    def read(self, storage: ReplayStorage, identity: str | None = None) -> dict[str, Any] | None:
        """Return the contents, checked, for `storage.load_state_dict`.

        Return None, with a warning, if the file is missing or of different environments, observations
        or capacity than `storage`, which is not changed.

        Raises:
            CheckpointError: the file is damaged or edited, or not of the checkpoint with `identity`
                (None: a checkpoint of an earlier version, without identity).
        """
        if not self.path.exists():
            logger.warning(
                "The replay starts empty: %s not found. Training continues from new steps only.",
                self.path,
            )
            return None
        cure = "delete this file, and the replay starts empty. Nothing was changed."
        try:
            state, is_intact = read_checkpoint(self.path)
            reason = "" if is_intact else "not as it was written, another checksum"
        except CheckpointError as error:
            reason = error.reason
        if reason:
            raise CheckpointError(f"Replay {str(self.path)!r} is damaged ({reason}); {cure}")
        if (found := state.get("identity")) != identity:
            raise CheckpointError(
                f"Replay {str(self.path)!r}: expected the replay of its checkpoint (identity "
                f"{identity!r}), got that of another one (identity {found!r}); {cure}"
            )
        try:
            storage.check_fits(state)
        except ValueError as error:
            logger.warning("The replay starts empty: the saved replay does not fit. %s", error)
            return None
        return state

    def remove_others(self) -> None:
        """Delete the replay files of the folder's other checkpoints."""
        for other in self.path.parent.glob("replay_model_*.pt"):
            # A folder of that name, or a file of another user, is no reason to end a run.
            with contextlib.suppress(OSError):
                if other != self.path:
                    other.unlink()
