"""Timers of alternating functions, and the bare `mujoco.batch` loop for comparison."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch

Sample = Callable[[], Any]


def alternate(
    *samples: Sample,
    steps: int = 20,
    repeats: int = 15,
    warm_up: int = 5,
    before: Sample = lambda: None,
    wait: Sample = lambda: None,
) -> list[float]:
    """Return the median time of each sample, in seconds, taking turns so that noise hits all.

    `before` is called before each round of samples, and not timed. `wait` returns when a device has
    done what samples have queued on it.
    """
    for sample in samples:
        for _ in range(warm_up):
            sample()
    times: list[list[float]] = [[] for _ in samples]
    turns = list(zip(samples, times, strict=True))
    for _ in range(repeats):
        before()
        # Reverse the order: the caches favor one position.
        turns.reverse()
        for sample, taken in turns:
            wait()
            begin = time.perf_counter()
            for _ in range(steps):
                sample()
            wait()
            taken.append((time.perf_counter() - begin) / steps)
    return [statistics.median(taken) for taken in times]


class BareLoop:
    """The substeps of one environment step on `mujoco.batch`, and nothing else.

    State goes in and out as double-precision views, which cost nothing, and no derived quantity is
    copied out.
    """

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, num_threads: int, decimation: int
    ) -> None:
        self._batch = Batch(model, num_envs, num_threads)
        self._decimation = decimation
        names = ["qpos", "qvel", "ctrl"]
        if model.nmocap > 0:
            # Positions of the arms' bases.
            names += ["mocap_pos", "mocap_quat"]
        self.state = {name: self._batch.bind(name) for name in names}
        self.qpos, self.qvel, self.ctrl = (self.state[name] for name in names[:3])
        self._rays: list[dict[str, Any]] = []

    def expand(self, fields: Mapping[str, torch.Tensor]) -> None:
        """Give every simulation its own values (num_envs, ...) of these model fields."""
        for name, values in fields.items():
            own = self._batch.expand(name)
            own[:] = values.numpy().reshape(own.shape)

    def cast(self, rays: Iterable[tuple[np.ndarray, np.ndarray, tuple[int, ...]]]) -> None:
        """Cast these rays at the end of every step: origins and directions (num_envs, R, 3), groups."""
        self._rays = []
        for origins, directions, groups in rays:
            mask = np.zeros(6, dtype=np.uint8)
            mask[list(groups)] = 1
            self._rays.append(
                {
                    "pnt": np.ascontiguousarray(origins, dtype=np.float64),
                    "vec": np.ascontiguousarray(directions, dtype=np.float64),
                    "normal": True,
                    "geomgroup": mask,
                }
            )

    def __call__(self) -> None:
        self._batch.step(nstep=self._decimation)
        for rays in self._rays:
            self._batch.ray(**rays)
