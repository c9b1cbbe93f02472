"""Refusal of more environments than the memory can hold, before any of it is taken."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import torch

if TYPE_CHECKING:
    from mjlab.sim.config import SimulationCfg

# Bytes of an environment without physics: its origin, episode clock, actions, reward and ends.
LEAST_BYTES = 64

_MEMORY = Path("/proc/meminfo")
_OWN_GROUPS = Path("/proc/self/cgroup")
_GROUPS = Path("/sys/fs/cgroup")


def check_memory(num_envs: int, bytes_each: int, device: str) -> None:
    """Raise ValueError if `num_envs` environments of at least `bytes_each` bytes cannot fit.

    The estimate is a lower bound, so that nothing that fits is refused. Where it is not known how
    much memory there is, nothing is checked.
    """
    memory = available_memory(device)
    needed = num_envs * bytes_each
    if memory is None or needed <= memory:
        return
    raise ValueError(
        f"num_envs: expected at most {memory // bytes_each:,}, which is what {memory / 1e9:.1f} GB of "
        f"memory on {device} can hold, got {num_envs:,}, which take at least {needed / 1e9:.1f} GB "
        f"({bytes_each:,} bytes each); use fewer. Learning takes memory besides."
    )


def bytes_per_environment(model: mujoco.MjModel, cfg: SimulationCfg, engine: str) -> int:
    """Return a lower bound on the memory of an environment of `model` in an engine."""
    if engine == "native":
        # The state in double precision, also from before the last step; positions and velocities in
        # single precision.
        size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION)
        return LEAST_BYTES + 2 * 8 * size + 4 * (model.nq + model.nv)
    # Numbers in single precision that MuJoCo Warp keeps of bodies (poses 28, inertias 20, velocities
    # and forces 18), geoms, sites, joints (axes, velocities, accelerations and forces), constraint rows and
    # contacts.
    numbers = 66 * model.nbody + 12 * (model.ngeom + model.nsite) + 20 * model.nv + model.nq
    numbers += 8 * (cfg.njmax or 0) + 16 * (cfg.nconmax or 0)
    return LEAST_BYTES + 4 * numbers


def available_memory(device: str) -> int | None:
    """Return the memory that new environments may take (bytes); None if it is not known.

    Of a GPU it is all that it has, because what earlier environments left in pools can be used again.
    On the CPU swap space counts, and the limits of control groups.
    """
    if torch.device(device).type == "cuda":
        try:
            return torch.cuda.mem_get_info(device)[1]
        except (RuntimeError, AssertionError):
            # A device that torch cannot use is refused where it is used.
            return None
    try:
        lines = [line.split() for line in _MEMORY.read_text().splitlines()]
        sizes = {words[0]: 1024 * int(words[1]) for words in lines if len(words) == 3}
        free = sizes["MemAvailable:"]
    except (OSError, ValueError, KeyError):
        return None
    return min([free, *_group_limits()]) + sizes.get("SwapFree:", 0)


def _group_limits() -> list[int]:
    """Return the memory limits of the control groups that this process is in (bytes).

    A line of `/proc/self/cgroup` is `<number>:<controllers>:<path>`; version 2 has no controllers.
    """
    try:
        lines = [line.split(":", 2) for line in _OWN_GROUPS.read_text().splitlines()]
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
                    text = (folder / name).read_text().strip()
                except OSError:
                    continue
                limits += [int(text)] if text.isdigit() else []
    return limits
