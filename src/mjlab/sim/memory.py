"""Memory check: number of environments against available memory, before any allocation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import torch

if TYPE_CHECKING:
    from mjlab.sim.config import SimulationCfg

# Bytes of an environment without physics: origin, episode length, actions, reward, terminations.
LEAST_BYTES = 64

_MEMORY = Path("/proc/meminfo")
_OWN_GROUPS = Path("/proc/self/cgroup")
_GROUPS = Path("/sys/fs/cgroup")


def check_memory(num_envs: int, bytes_each: int, device: str) -> None:
    """Raise `ValueError` if `num_envs` environments of at least `bytes_each` bytes do not fit.

    The estimate is a lower bound, so everything that fits passes. If the available memory is
    unknown, nothing is checked.
    """
    memory = available_memory(device)
    needed = num_envs * bytes_each
    if memory is None or needed <= memory:
        return
    raise ValueError(
        f"num_envs: expected at most {memory // bytes_each:,} ({memory / 1e9:.1f} GB of memory on "
        f"{device}), got {num_envs:,} (at least {needed / 1e9:.1f} GB, {bytes_each:,} bytes each); use "
        "fewer environments. Training needs additional memory."
    )


def bytes_per_environment(model: mujoco.MjModel, cfg: SimulationCfg, engine: str) -> int:
    """Return a lower bound on the memory of one environment of `model` (bytes)."""
    if engine == "native":
        # State before and after the last step in float64; positions and velocities in float32.
        size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION)
        return LEAST_BYTES + 2 * 8 * size + 4 * (model.nq + model.nv)
    # float32 values in MuJoCo Warp: bodies (poses 28, inertias 20, velocities and forces 18),
    # geoms, sites, joints (axes, velocities, accelerations and forces), constraint rows, contacts.
    numbers = 66 * model.nbody + 12 * (model.ngeom + model.nsite) + 20 * model.nv + model.nq
    numbers += 8 * (cfg.njmax or 0) + 16 * (cfg.nconmax or 0)
    return LEAST_BYTES + 4 * numbers


def available_memory(device: str) -> int | None:
    """Return the memory available to new environments (bytes); None if unknown.

    For a GPU this is its total memory, because pools left by earlier environments are reused. For
    the CPU it includes swap space, and respects the limits of control groups.
    """
    if torch.device(device).type == "cuda":
        try:
            return torch.cuda.mem_get_info(device)[1]
        except (RuntimeError, AssertionError):
            # A device that torch cannot use raises later, where it is used.
            return None
    try:
        lines = [line.split() for line in _MEMORY.read_text(encoding="utf-8").splitlines()]
        sizes = {words[0]: 1024 * int(words[1]) for words in lines if len(words) == 3}
        free = sizes["MemAvailable:"]
    except (OSError, ValueError, KeyError):
        return None
    return min([free, *_group_limits()]) + sizes.get("SwapFree:", 0)


def _group_limits() -> list[int]:
    """Return the memory limits of the control groups of this process (bytes).

    A line of `/proc/self/cgroup` is `<number>:<controllers>:<path>`; version 2 has no controllers.
    """
    try:
        lines = [
            line.split(":", 2) for line in _OWN_GROUPS.read_text(encoding="utf-8").splitlines()
        ]
    except OSError:
        return []
    limits = []
    for _, controllers, path in lines:
        if controllers and "memory" not in controllers.split(","):
            continue
        root = _GROUPS / "memory" if controllers else _GROUPS
        name = "memory.limit_in_bytes" if controllers else "memory.max"
        group = root / path.lstrip("/")
        for folder in (group, *group.parents):
            if folder.is_relative_to(root):
                try:
                    text = (folder / name).read_text(encoding="utf-8").strip()
                except OSError:
                    continue
                limits += [int(text)] if text.isdigit() else []
    return limits
