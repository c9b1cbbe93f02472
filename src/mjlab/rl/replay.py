"""The replay storage of the off-policy learner: the last steps of every environment."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from mjlab.rl.checkpoint import load_checkpoint, save_checkpoint
from mjlab.utils.errors import check_count

logger = logging.getLogger(__name__)

# How an environment step ended, from the learner's view.
_GOES_ON, _TERMINATED, _TIMED_OUT, _CUT_OFF = range(4)
# Time-outs are rare: for one step in so many there is room for the observation an episode ended in.
_STEPS_PER_TIME_OUT = 32


@dataclass
class Batch:
    """Transitions drawn from the replay, each over one environment step or several."""

    observations: TensorDict
    """Observation groups (B, numbers) before the transition."""
    actions: torch.Tensor
    """Actions (B, A)."""
    returns: torch.Tensor
    """Discounted sums of rewards (B,)."""
    discounts: torch.Tensor
    """Factor (B,) of the value of `next_observations`; 0 where the episode was terminated."""
    next_observations: TensorDict
    """Observation groups (B, numbers) after the transition."""
    weights: torch.Tensor
    """Weight (B,) in the loss: 0 where it is not known what followed, else 1."""


class ReplayStorage:
    """The last `num_steps` environment steps of N environments, in a ring.

    An observation is stored once: the one after a step is the one before the next step. Where an
    episode ran out of time, the observation that it ended in is kept apart.

    Everything is allocated at once; `num_bytes` says how much that is.
    """

    def __init__(
        self, num_steps: int, observations: TensorDict, groups: Sequence[str], num_actions: int
    ) -> None:
        """Take the number of steps and the first observations.

        Args:
            num_steps: Steps of each environment to keep.
            observations: Observations of all environments, of batch size (N,).
            groups: Names of the groups to keep.
            num_actions: Number of actions A.

        Raises:
            ValueError: there is no step to keep.
        """
        check_count("SAC replay_steps", num_steps)
        self._num_envs = len(observations)
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
        # Which of all ends that were ever stored belongs to a step that timed out.
        self._end_numbers = zeros(rows, envs, dtype=torch.int64)
        self._num_ends_stored = 0
        self._row = 0
        self._num_filled = 0
        self._put(observations)

    @property
    def num_filled(self) -> int:
        """Number of steps stored of each environment."""
        return self._num_filled

    @property
    def num_bytes(self) -> int:
        """Size of all tensors."""
        return sum(tensor.nbytes for tensor in self._tensors().values())

    def start(self, observations: TensorDict) -> None:
        """Take the observations that the next step starts from, where `add` has not had them.

        Where they are others than those that the last step led to, what that step led to is not
        known.
        """
        if self._num_filled > 0:
            elsewhere = torch.zeros(self._num_envs, dtype=torch.bool, device=self._device)
            for name, stored in self._observations.items():
                elsewhere |= (stored[self._row] != observations[name]).flatten(1).any(dim=1)
            last = self._kinds[self._row - 1]
            last[elsewhere & (last == _GOES_ON)] = _CUT_OFF
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
            actions: (N, A).
            rewards: (N,).
            dones: (N,), whether the episode ended.
            time_outs: (N,), whether it only ran out of time; None: it never does.
            next_observations: Those to act on next; of the new episode, where one ended.
            final_ids: (k,), environments of which it is known in what their episode ended.
            final_observations: Their observations, of batch size (k,).
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
        """Draw `size` transitions, each over `num_steps` steps or up to the end of the episode.

        `gamma` discounts rewards; `generator` is the source of the random numbers.
        """
        steps = min(num_steps, self._num_filled)
        starts = self._num_filled - steps + 1
        drawn = torch.randint(
            starts * self._num_envs, (size,), generator=generator, device=self._device
        )
        envs = drawn % self._num_envs
        # Steps count from the oldest one.
        oldest = self._row - self._num_filled
        first = (oldest + drawn // self._num_envs) % (self._num_steps + 1)
        kind = torch.zeros_like(drawn, dtype=torch.int8)
        returns = torch.zeros(size, device=self._device)
        discounts = torch.ones(size, device=self._device)
        last = first
        for step in range(steps):
            row = (first + step) % (self._num_steps + 1)
            runs = kind == _GOES_ON
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

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict`.

        Raises:
            ValueError: the state is of other environments, observations or another length; nothing
                was changed then.
        """
        own, saved = self._tensors(), state["tensors"]
        expected = {name: tuple(tensor.shape) for name, tensor in own.items()}
        found = {name: tuple(tensor.shape) for name, tensor in saved.items()}
        if expected != found:
            raise ValueError(f"The saved replay has tensors {found}, and this run's {expected}.")
        for name, tensor in own.items():
            tensor.copy_(saved[name])
        self._row = state["row"]
        self._num_filled = state["num_filled"]
        self._num_ends_stored = state["num_ends_stored"]

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
    """The replay beside a checkpoint: `replay_model_100.pt` beside `model_100.pt`.

    In a file of its own, because it is a thousand times as large as the networks; only the newest
    checkpoint of a folder has one.
    """

    def __init__(self, checkpoint: str | os.PathLike[str]) -> None:
        """Take the path of the checkpoint."""
        path = Path(checkpoint)
        self.path = path.with_name(f"replay_{path.name}")
        """The file."""

    def write(self, storage: ReplayStorage) -> None:
        """Write the contents of `storage`.

        Raises:
            CheckpointError: it could not be written.
        """
        save_checkpoint(storage.state_dict(), self.path)

    def read(self, storage: ReplayStorage) -> None:
        """Fill `storage`; warn where there is no file, or one of other environments.

        Raises:
            CheckpointError: the file is damaged.
        """
        if not self.path.exists():
            logger.warning(
                "The replay starts empty: %s is not there. Learning goes on from new steps only.",
                self.path,
            )
            return
        try:
            storage.load_state_dict(load_checkpoint(self.path))
        except (KeyError, ValueError) as error:
            logger.warning("The replay starts empty, because the saved one does not fit. %s", error)

    def remove_others(self) -> None:
        """Delete the replays of the folder's other checkpoints."""
        for other in self.path.parent.glob("replay_model_*.pt"):
            if other != self.path:
                other.unlink(missing_ok=True)
