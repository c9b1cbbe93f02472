"""Base class of sensors: spec edits, cached data, life cycle."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar, cast

import torch

from mjlab.utils.state import stateful

if TYPE_CHECKING:
    import mujoco

    from mjlab.entity import Entity
    from mjlab.sim.engine import Stage
    from mjlab.viewer.debug_visualizer import DebugVisualizer

T = TypeVar("T")


@dataclass
class SensorCfg(ABC):
    """Base sensor configuration."""

    name: str
    """Name of the sensor, without the prefix of an entity."""

    @property
    def prefixed_name(self) -> str:
        """Name of the sensor in the scene."""
        return self.name

    @abstractmethod
    def build(self) -> Sensor[Any]:
        """Build the sensor."""


@stateful
class Sensor(ABC, Generic[T]):
    """Base class of sensors. `data` is a measurement in all environments.

    `data` is computed on first access and cached until time advances (`update`), an environment is
    reset (`reset`), or `sim.forward` recomputes its source fields (the scene then calls
    `invalidate_cache`). So `data` and its source fields always belong to the same state.

    Subclasses compute their data in `_compute_data`. A subclass that overrides `update`, to keep a
    history, is updated every physics substep. If it needs only data fields of a substep, it lists
    them in `recorded_fields` and overrides `update_recorded` too, so that the engine can run the
    substeps in one go.
    """

    _transient = {"_cached_data", "_cache_valid"}

    earliest_stage: ClassVar[Stage] = "pos"
    """Earliest stage of a forward pass that changes the data. `"acc"`: the data depends only on
    `sensordata` of the acceleration stage, and stays valid after `sim.forward(stage="vel")`."""

    def __init__(self) -> None:
        self._cached_data: T | None = None
        self._cache_valid = False

    def edit_spec(self, scene_spec: mujoco.MjSpec, entities: dict[str, Entity]) -> None:
        """Add the elements of the sensor to the scene's spec. Default: no elements."""

    @abstractmethod
    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Bind the sensor to a simulation: compiled model, model fields, data fields, device."""

    @property
    def data(self) -> T:
        """Current sensor data."""
        if not self._cache_valid:
            self._cached_data = self._compute_data()
            self._cache_valid = True
        return cast("T", self._cached_data)

    @abstractmethod
    def _compute_data(self) -> T:
        """Return the data of the current simulation state."""

    def invalidate_cache(self) -> None:
        """Recompute the data on next access."""
        self._cache_valid = False

    def _invalidate_cache(self) -> None:
        self.invalidate_cache()

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Reset sensor state of `env_ids` (None: all)."""
        self.invalidate_cache()

    def update(self, dt: float) -> None:
        """Update the sensor after the simulation has advanced by `dt` seconds."""
        self.invalidate_cache()

    @property
    def recorded_fields(self) -> tuple[str, ...]:
        """Data fields to record after every substep for `update_recorded`. Default: no fields."""
        return ()

    def update_recorded(self, recorded: dict[str, torch.Tensor], dt: float) -> None:
        """Update the sensor as `update` would after each of several substeps of `dt` seconds.

        `recorded`: values of `recorded_fields` after every substep, (substeps, N, ...).
        """
        raise NotImplementedError(
            f"{type(self).__name__}: update_recorded is required for recorded_fields "
            f"{self.recorded_fields}."
        )

    @property
    def needs_substep(self) -> bool:
        """True if `update` must be called after every physics substep."""
        return type(self).update is not Sensor.update

    @property
    def draws(self) -> bool:
        """True if `debug_vis` draws anything. Viewers then offer a switch for it."""
        return type(self).debug_vis is not Sensor.debug_vis

    def debug_vis(self, visualizer: DebugVisualizer) -> None:
        """Draw the measurements. Default: no drawing."""
