"""What all sensors share: a place in the scene's spec, cached data, and a life cycle."""

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
    """Describes a sensor."""

    name: str
    """Name of the sensor, without the prefix of an entity."""

    @property
    def prefixed_name(self) -> str:
        """Name under which the scene keeps the sensor."""
        return self.name

    @abstractmethod
    def build(self) -> Sensor[Any]:
        """Build the sensor."""


@stateful
class Sensor(ABC, Generic[T]):
    """Reads something from the simulation, in all environments.

    `data` is computed when it is first read, and kept until time passes (`update`), the
    environment is reset (`reset`), or `sim.forward` recomputes the fields that it is made of
    (the scene then calls `invalidate_cache`). So it always belongs to the same state as these
    fields of the simulation.

    A subclass computes its data in `_compute_data`. One that overrides `update`, because it keeps
    a history, is updated at every physics substep. If all it needs of a substep is data fields, it
    names them in `recorded_fields` and overrides `update_recorded` too, so that the engine can run
    the substeps in one go.
    """

    _transient = {"_cached_data", "_cache_valid"}

    earliest_stage: ClassVar[Stage] = "pos"
    """Earliest stage of a forward pass that changes the data. `"acc"`: the data is made of
    `sensordata` of the acceleration stage only, and outlasts `sim.forward(stage="vel")`."""

    def __init__(self) -> None:
        self._cached_data: T | None = None
        self._cache_valid = False

    def edit_spec(self, scene_spec: mujoco.MjSpec, entities: dict[str, Entity]) -> None:
        """Add to the scene's spec what the sensor needs; nothing by default."""

    @abstractmethod
    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Tie the sensor to a simulation: compiled model, model fields, data fields, device."""

    @property
    def data(self) -> T:
        """The sensor's current data."""
        if not self._cache_valid:
            self._cached_data = self._compute_data()
            self._cache_valid = True
        return cast("T", self._cached_data)

    @abstractmethod
    def _compute_data(self) -> T:
        """Return the data of the simulation as it is now."""

    def invalidate_cache(self) -> None:
        """Compute the data anew when it is next read."""
        self._cache_valid = False

    def _invalidate_cache(self) -> None:
        self.invalidate_cache()

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Forget what was measured in these environments."""
        self.invalidate_cache()

    def update(self, dt: float) -> None:
        """Take note that the simulation has advanced by `dt` seconds."""
        self.invalidate_cache()

    @property
    def recorded_fields(self) -> tuple[str, ...]:
        """Data fields whose values after every substep `update_recorded` takes; none by default."""
        return ()

    def update_recorded(self, recorded: dict[str, torch.Tensor], dt: float) -> None:
        """Do what `update` would have done after each of several substeps of `dt` seconds.

        `recorded` has the values of `recorded_fields` after every substep, (substeps, N, ...).
        """
        raise NotImplementedError(f"{type(self).__name__} records {self.recorded_fields}.")

    @property
    def needs_substep(self) -> bool:
        """Whether `update` has to be called after every physics substep."""
        return type(self).update is not Sensor.update

    @property
    def draws(self) -> bool:
        """Whether `debug_vis` draws anything, so that viewers offer a switch for it."""
        return type(self).debug_vis is not Sensor.debug_vis

    def debug_vis(self, visualizer: DebugVisualizer) -> None:
        """Draw what the sensor measures; nothing by default."""
