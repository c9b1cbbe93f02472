"""Per-environment model fields on a MuJoCo Warp model that a package holds itself.

Use `sim.expand_model_fields` wherever there is a `Simulation`: it works on both engines.
"""

from __future__ import annotations

from typing import Any


def expand_model_fields(model: Any, nworld: int, fields_to_expand: list[str]) -> None:
    """Give each of `nworld` worlds its own row of fields of a `mujoco_warp.Model`, in place.

    Rows start as the shared one; fields that are per world already are left alone. A CUDA graph
    captured before has to be captured again (`sim.create_graph()`).

    Raises:
        ValueError: no such field, or one that MuJoCo Warp cannot hold per world.
    """
    from mjlab.sim.warp.engine import expand_arrays

    expand_arrays(getattr(model, "struct", model), nworld, list(fields_to_expand))
