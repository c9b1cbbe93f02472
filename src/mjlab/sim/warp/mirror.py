"""MuJoCo Warp structs on the tensors of the native engine, for code that calls MuJoCo Warp itself."""

from __future__ import annotations

import contextlib
import logging
from functools import cached_property
from typing import TYPE_CHECKING, Any

import mujoco_warp as mjwarp
import torch
import warp as wp

from mjlab.sim.warp.engine import (
    as_torch,
    check_supported,
    find_device,
    find_model_field,
    offered_data_fields,
)

if TYPE_CHECKING:
    import mujoco

    from mjlab.sim.config import SimulationCfg
    from mjlab.sim.engine import Engine

logger = logging.getLogger(__name__)


class WarpMirror:
    """Model and data of MuJoCo Warp that share memory with an engine on the CPU.

    Data fields that both engines provide are the engine's tensors: Warp functions read the current
    values, and what they write is read in `sim.data` and, if it is an input, by the next step. Of
    the model only expanded fields are shared; writing the others changes results of Warp only.
    """

    def __init__(
        self, engine: Engine, model: mujoco.MjModel, host: mujoco.MjData, cfg: SimulationCfg
    ) -> None:
        self._engine, self._mj_model, self._host, self._cfg = engine, model, host, cfg
        self.wp_device = find_device(torch.device("cpu"))

    @cached_property
    def wp_data(self) -> Any:
        """Data. Reading it the first time makes the engine compute all fields in every step."""
        model, cfg = self._mj_model, self._cfg
        check_supported(model)
        logger.warning(
            "sim.wp_model and sim.wp_data: expected the warp engine, got native. The data share "
            "the memory of sim.data, and the model that of expanded fields; other writes to the "
            "model have no effect on steps. Use --engine warp "
            '(cfg.sim.engine = "warp") to step with MuJoCo Warp.'
        )
        with wp.ScopedDevice(self.wp_device):
            data = mjwarp.put_data(
                model, self._host, self._engine.num_envs, nconmax=cfg.nconmax, njmax=cfg.njmax
            )
        for name in offered_data_fields(data):
            with contextlib.suppress(AttributeError):
                _share(data, name, self._engine.data_field(name))
        return data

    @property
    def wp_model(self) -> Any:
        """Model, with the fields that are expanded by now."""
        for name, tensor in self._engine.model_fields.items():
            with contextlib.suppress(ValueError):
                _share(*find_model_field(self._wp_model, name), tensor)
        return self._wp_model

    @cached_property
    def _wp_model(self) -> Any:
        _ = self.wp_data
        with wp.ScopedDevice(self.wp_device):
            return mjwarp.put_model(self._mj_model)


def _share(struct: Any, name: str, tensor: torch.Tensor) -> None:
    """Replace an array by one on the memory of a tensor (N, ...) of the same layout."""
    array = getattr(struct, name)
    row = as_torch(array)[0]
    if array.size == 0 or row.dtype != tensor.dtype or row.numel() != tensor[0].numel():
        return
    shared = wp.from_torch(tensor.view(-1, *row.shape), dtype=array.dtype)
    # MuJoCo Warp marks arrays with a leading world dimension.
    shared._is_batched = True
    setattr(struct, name, shared)
