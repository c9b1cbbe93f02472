"""Sensors that MuJoCo computes itself: any element of an MJCF `<sensor>` section."""

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

_FRAME = ("body", "xbody", "geom", "site", "camera")

# Kinds that MJCF and MuJoCo's headers name differently; both names are taken.
_ENUM_NAMES = {"jointactuatorfrc": "jointactfrc", "tendonactuatorfrc": "tendonactfrc"}

# What each kind of sensor may be attached to, by the start of its name; the first that fits counts.
_OBJECTS: dict[str, tuple[str, ...]] = {
    "frame": _FRAME,
    "subtree": ("body",),
    "joint": ("joint",),
    "tendon": ("tendon",),
    "actuator": ("actuator",),
    "clock": (),
    "e_potential": (),
    "e_kinetic": (),
    "": ("site",),
}


@dataclass
class ObjRef:
    """An element of the scene."""

    type: ObjType
    """Kind of the element. `body` means its inertial frame, `xbody` its regular frame."""
    name: str
    """Name, without the prefix of its entity."""
    entity: str | None = None
    """The entity that the element belongs to, `terrain` included; None takes `name` as it is in the
    scene."""

    def prefixed_name(self) -> str:
        """Return the element's name in the scene, except that a terrain has no prefix there."""
        return f"{self.entity}/{self.name}" if self.entity else self.name


@dataclass
class BuiltinSensorCfg(SensorCfg):
    """Describes a MuJoCo sensor to add to the scene.

    The scene keeps it, and MuJoCo calls it, `<entity>/<name>` if `obj` belongs to an entity.
    """

    sensor_type: SensorType
    """MuJoCo's name of the kind of sensor."""
    obj: ObjRef | None = None
    """What the sensor is attached to."""
    ref: ObjRef | None = None
    """Frame in which a frame sensor reports; None for the world."""
    cutoff: float = 0.0
    """Bound on the absolute value of the data; 0 for none."""

    def __post_init__(self) -> None:
        check_one_of(f"Sensor {self.name!r} sensor_type", self.sensor_type, get_args(SensorType))
        allowed = next(v for start, v in _OBJECTS.items() if self.sensor_type.startswith(start))
        self._check(self.obj, "obj", allowed)
        if self.ref is not None:
            if not self.sensor_type.startswith("frame"):
                raise ValueError(
                    f"Sensor {self.name!r}: a {self.sensor_type} takes no ref; only frame sensors "
                    "(framepos, framequat, ...) report in another frame."
                )
            self._check(self.ref, "ref", _FRAME)

    def _check(self, obj: ObjRef | None, field: str, allowed: tuple[str, ...]) -> None:
        given = None if obj is None else obj.type
        if given in allowed or (not allowed and obj is None):
            return
        wanted = f"an ObjRef of type {' or '.join(allowed)}" if allowed else "None"
        raise ValueError(
            f"Sensor {self.name!r}: {field} of a {self.sensor_type} must be {wanted}, got "
            f"{'None' if obj is None else f'type {given!r}'}."
        )

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
    """A MuJoCo sensor. Its data is (N, dimension), in MuJoCo's units and frames.

    The data is a view of the simulation, which changes it at every step and `forward`.
    """

    _transient = {"_sensordata"}

    def __init__(self, cfg: BuiltinSensorCfg | None = None, name: str | None = None) -> None:
        """Stand for a sensor to add (`cfg`), or for one that the spec has already (`name`)."""
        super().__init__()
        if (cfg is None) == (name is None):
            raise ValueError("Give BuiltinSensor exactly one of `cfg` and `name`.")
        self.cfg = cfg
        self._name = cfg.prefixed_name if cfg is not None else name
        self._sim_data: Any = None
        self._columns = (0, 0)
        self._sensordata: torch.Tensor | None = None

    @classmethod
    def from_existing(cls, name: str) -> BuiltinSensor:
        """Return the sensor that stands for a MuJoCo sensor of the spec, by its full name."""
        return cls(name=name)

    def edit_spec(self, scene_spec: mujoco.MjSpec, entities: dict[str, Entity]) -> None:
        """Add the sensor to the scene's spec, if it is not there already.

        Raises:
            ValueError: the spec has a sensor of this name, or the entity or element named does
                not exist; lists those that do.
        """
        cfg = self.cfg
        if cfg is None:
            return
        name = cfg.prefixed_name
        if any(sensor.name == name for sensor in scene_spec.sensors):
            where = f"entity {cfg.obj.entity!r}" if cfg.obj and cfg.obj.entity else "the scene"
            raise ValueError(
                f"Sensor {name!r} exists already in {where}: its XML defines it, or two configs "
                "do. Rename one, or drop the config: sensors of the XML are available anyway."
            )
        kind = _ENUM_NAMES.get(cfg.sensor_type, cfg.sensor_type)
        sensor = scene_spec.add_sensor(
            name=name, type=getattr(mujoco.mjtSensor, f"mjSENS_{kind.upper()}")
        )
        for ref, kind in ((cfg.obj, "obj"), (cfg.ref, "ref")):
            if ref is not None:
                check_entity(f"Sensor {name!r}", ref, entities)
                elements = "bodies" if ref.type in ("body", "xbody") else f"{ref.type}s"
                names = [element.name for element in getattr(scene_spec, elements)]
                setattr(sensor, f"{kind}name", find_in_scene(f"Sensor {name!r}", ref, names))
                setattr(sensor, f"{kind}type", getattr(mujoco.mjtObj, f"mjOBJ_{ref.type.upper()}"))
        if cfg.sensor_type == "rangefinder":
            # Of what a rangefinder can report, the distance alone.
            sensor.intprm[0] = 1 << int(mujoco.mjtRayDataField.mjRAYDATA_DIST)
        if cfg.cutoff > 0.0:
            sensor.cutoff = cfg.cutoff

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Find the sensor in the compiled model."""
        sensor = mj_model.sensor(self._name)
        start = int(sensor.adr[0])
        self._columns = (start, start + int(sensor.dim[0]))
        self._sim_data = data

    def _compute_data(self) -> torch.Tensor:
        # Asking for `sensordata` makes the engine copy it out, so only a sensor that is read does.
        if self._sensordata is None:
            self._sensordata = self._sim_data.sensordata[:, slice(*self._columns)]
        return self._sensordata


def check_entity(owner: str, ref: ObjRef, entities: dict[str, Entity]) -> None:
    """Raise `ValueError`, which opens with `owner`, unless the entity of `ref` exists."""
    if ref.entity and ref.entity not in entities:
        raise ValueError(f"{owner}: unknown entity {ref.entity!r}; {suggest(ref.entity, entities)}")


def find_in_scene(owner: str, ref: ObjRef, names: Sequence[str]) -> str:
    """Return the name in the scene of the element that `ref` refers to.

    Args:
        owner: Start of the message.
        ref: Reference to an element.
        names: Names of all elements of its type in the scene.

    Raises:
        ValueError: the entity, or the scene, does not have the element.
    """
    prefix = f"{ref.entity}/" if ref.entity else ""
    offered = {name.removeprefix(prefix): name for name in names if name.startswith(prefix)}
    if ref.entity == _TERRAIN:
        # A name with a prefix belongs to another entity. Where there is no terrain, an entity may
        # be called so, and has its prefix.
        offered = {name: name for name in names if name and "/" not in name} | offered
    offered.pop("", None)
    if ref.name not in offered:
        where = f"entity {ref.entity!r}" if ref.entity else "the scene"
        raise ValueError(
            f"{owner}: unknown {ref.type} {ref.name!r} in {where}; {suggest(ref.name, offered)}"
        )
    return offered[ref.name]
