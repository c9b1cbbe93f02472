"""Built-in sensors: elements of MJCF's `<sensor>` section, computed by MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import mujoco
import torch

from mjlab.sensor.sensor import Sensor, SensorCfg
from mjlab.utils.errors import check_one_of
from mjlab.utils.string import suggest

if TYPE_CHECKING:
    from mjlab.entity import Entity


ObjType = Literal["body", "xbody", "joint", "geom", "site", "actuator", "tendon", "camera"]
SensorType = Literal[
    "accelerometer", "velocimeter", "gyro", "force", "torque", "magnetometer", "rangefinder",
    "framepos", "framequat", "framexaxis", "frameyaxis", "framezaxis", "framelinvel",
    "frameangvel", "framelinacc", "frameangacc",
    "subtreecom", "subtreelinvel", "subtreeangmom",
    "jointpos", "jointvel", "jointlimitpos", "jointlimitvel", "jointlimitfrc", "jointactuatorfrc",
    "tendonpos", "tendonvel", "tendonlimitpos", "tendonlimitvel", "tendonlimitfrc",
    "tendonactuatorfrc",
    "jointactfrc", "tendonactfrc", "actuatorpos", "actuatorvel", "actuatorfrc",
    "clock", "e_potential", "e_kinetic",
]  # fmt: skip

# The scene attaches its terrain without a prefix.
_TERRAIN = "terrain"

# MJCF names of sensor types whose `mjtSensor` constant has another name; both are accepted.
_ENUM_NAMES = {"jointactuatorfrc": "jointactfrc", "tendonactuatorfrc": "tendonactfrc"}


@dataclass
class ObjRef:
    """Reference to an element of the scene."""

    type: ObjType
    """Element type. `body` is the inertial frame of a body, `xbody` its regular frame."""
    name: str
    """Element name without entity prefix."""
    entity: str | None = None
    """Name of the element's entity (`terrain` included). None: `name` is the full scene name."""

    def __str__(self) -> str:
        """Return type and scene name: `site robot/imu`."""
        return f"{self.type} {self.prefixed_name()}"

    def prefixed_name(self) -> str:
        """Return `<entity>/<name>`. Terrain elements have no prefix in the scene."""
        return f"{self.entity}/{self.name}" if self.entity else self.name


@dataclass
class BuiltinSensorCfg(SensorCfg):
    """Configuration of a MuJoCo sensor to add to the scene.

    Its name in the scene and in MuJoCo is `<entity>/<name>` if `obj` belongs to an entity.
    """

    sensor_type: SensorType
    """MuJoCo sensor type."""
    obj: ObjRef | None = None
    """Element the sensor is attached to."""
    ref: ObjRef | None = None
    """Reference frame of a frame sensor. None: world."""
    cutoff: float = 0.0
    """Bound on the absolute value of the data. 0: no bound."""

    @property
    def prefixed_name(self) -> str:
        """Name in the scene and in MuJoCo."""
        if self.obj is not None and self.obj.entity:
            return f"{self.obj.entity}/{self.name}"
        return self.name

    def build(self) -> BuiltinSensor:
        """Build the sensor."""
        return BuiltinSensor(cfg=self)


class BuiltinSensor(Sensor[torch.Tensor]):
    """MuJoCo sensor. Data is (N, dimension), in MuJoCo's units and frames.

    The data is a live view of the simulation: every step and every `forward` overwrite it.
    """

    _transient = {"_sensordata"}

    def __init__(self, cfg: BuiltinSensorCfg | None = None, name: str | None = None) -> None:
        """Wrap a sensor to add (`cfg`) or an existing MuJoCo sensor (`name`)."""
        super().__init__()
        if (cfg is None) == (name is None):
            raise ValueError("BuiltinSensor: expected exactly one of `cfg` and `name`.")
        self.cfg = cfg
        self._name = cfg.prefixed_name if cfg is not None else name
        self._sim_data: Any = None
        self._columns = (0, 0)
        self._sensordata: torch.Tensor | None = None

    @classmethod
    def from_existing(cls, name: str) -> BuiltinSensor:
        """Wrap the MuJoCo sensor with this full name."""
        return cls(name=name)

    def edit_spec(self, scene_spec: mujoco.MjSpec, entities: dict[str, Entity]) -> None:
        """Add the sensor to the scene's spec, unless it wraps an existing one.

        Raises:
            ValueError: duplicate sensor name, or unknown type, entity or element (with the
                available names).
        """
        cfg = self.cfg
        if cfg is None:
            return
        name = cfg.prefixed_name
        if any(sensor.name == name for sensor in scene_spec.sensors):
            where = f"entity {cfg.obj.entity!r}" if cfg.obj and cfg.obj.entity else "the scene"
            raise ValueError(
                f"Sensor {name!r} already exists in {where}: defined by its XML or by two configs. "
                "Rename one, or remove the config: sensors of the XML are available without one."
            )
        check_one_of(f"Sensor {name!r} sensor_type", cfg.sensor_type, get_args(SensorType))
        kind = _ENUM_NAMES.get(cfg.sensor_type, cfg.sensor_type)
        sensor = scene_spec.add_sensor(
            name=name, type=getattr(mujoco.mjtSensor, f"mjSENS_{kind.upper()}")
        )
        is_global = cfg.sensor_type in ("clock", "e_potential", "e_kinetic")
        for ref, kind in () if is_global else ((cfg.obj, "obj"), (cfg.ref, "ref")):
            if ref is not None:
                check_entity(f"Sensor {name!r}", ref, entities)
                elements = "bodies" if ref.type in ("body", "xbody") else f"{ref.type}s"
                names = [element.name for element in getattr(scene_spec, elements)]
                setattr(sensor, f"{kind}name", find_in_scene(f"Sensor {name!r}", ref, names))
                setattr(sensor, f"{kind}type", getattr(mujoco.mjtObj, f"mjOBJ_{ref.type.upper()}"))
        if cfg.sensor_type == "rangefinder":
            # Distance only: a rangefinder can also report direction, origin, point, normal, depth.
            sensor.intprm[0] = 1 << int(mujoco.mjtRayDataField.mjRAYDATA_DIST)
        if cfg.cutoff > 0.0:
            sensor.cutoff = cfg.cutoff

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Locate the sensor in `sensordata`."""
        sensor = mj_model.sensor(self._name)
        start = int(sensor.adr[0])
        self._columns = (start, start + int(sensor.dim[0]))
        self._sim_data = data

    def _compute_data(self) -> torch.Tensor:
        # Accessing `sensordata` makes the engine copy it out; unread sensors avoid that cost.
        if self._sensordata is None:
            self._sensordata = self._sim_data.sensordata[:, slice(*self._columns)]
        return self._sensordata


def check_entity(owner: str, ref: ObjRef, entities: dict[str, Entity]) -> None:
    """Raise `ValueError` unless the entity of `ref` exists. The message opens with `owner`."""
    if ref.entity and ref.entity not in entities:
        raise ValueError(f"{owner}: unknown entity {ref.entity!r}; {suggest(ref.entity, entities)}")


def find_in_scene(owner: str, ref: ObjRef, names: Sequence[str]) -> str:
    """Return the full scene name of the element `ref` refers to.

    Args:
        owner: Start of the message.
        ref: Reference to an element.
        names: Names of all elements of its type in the scene.

    Raises:
        ValueError: unknown element.
    """
    prefix = f"{ref.entity}/" if ref.entity else ""
    offered = {name.removeprefix(prefix): name for name in names if name.startswith(prefix)}
    if ref.entity == _TERRAIN:
        # Terrain elements have no prefix; a prefixed name belongs to another entity. In a scene
        # without terrain, an entity may be named 'terrain' and then has its prefix.
        offered = {name: name for name in names if name and "/" not in name} | offered
    offered.pop("", None)
    if ref.name not in offered:
        where = f"entity {ref.entity!r}" if ref.entity else "the scene"
        raise ValueError(
            f"{owner}: unknown {ref.type} {ref.name!r} in {where}; {suggest(ref.name, offered)}"
        )
    return offered[ref.name]
