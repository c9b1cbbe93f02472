"""Sensors that MuJoCo computes itself: any element of an MJCF `<sensor>` section."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import mujoco
import torch

from mjlab.sensor.sensor import Sensor, SensorCfg
from mjlab.utils.string import name_list

if TYPE_CHECKING:
    from mjlab.entity import Entity


# MERGED mjlab.sensor.builtin_sensor: Names in the scene of what an `ObjRef` refers to.


# The scene attaches its terrain without a prefix.
_TERRAIN = "terrain"


def find_in_scene(ref: ObjRef, names: Iterable[str]) -> tuple[str | None, list[str]]:
    """Look for what `ref` refers to among the `names` that elements of its kind have in the scene.

    Returns its name in the scene, None if there is no such element; and the names that the owner
    has to offer, without its prefix.
    """
    prefix = f"{ref.entity}/" if ref.entity else ""
    offered = {name.removeprefix(prefix): name for name in names if name.startswith(prefix)}
    if ref.entity == _TERRAIN:
        # A name with a prefix belongs to another entity. Where there is no terrain, an entity may
        # be called so, and has its prefix.
        offered = {name: name for name in names if name and "/" not in name} | offered
    offered.pop("", None)
    return offered.get(ref.name), list(offered)


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
        if self.sensor_type not in get_args(SensorType):
            raise ValueError(
                f"Sensor {self.name!r}: sensor_type={self.sensor_type!r} is unknown. Choose from: "
                f"{', '.join(get_args(SensorType))}."
            )
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
        if cfg.obj is not None:
            sensor.objname = _full_name(name, cfg.obj, scene_spec, entities)
            sensor.objtype = _object_type(cfg.obj)
        if cfg.ref is not None:
            sensor.refname = _full_name(name, cfg.ref, scene_spec, entities)
            sensor.reftype = _object_type(cfg.ref)
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


def _object_type(obj: ObjRef) -> mujoco.mjtObj:
    return getattr(mujoco.mjtObj, f"mjOBJ_{obj.type.upper()}")


def _full_name(sensor: str, obj: ObjRef, spec: mujoco.MjSpec, entities: dict[str, Entity]) -> str:
    """Return the name in the scene of what `obj` refers to; ValueError if there is no such thing."""
    if obj.entity and obj.entity not in entities:
        raise ValueError(
            f"Sensor {sensor!r} refers to the entity {obj.entity!r}. The scene has: "
            f"{sorted(entities)}."
        )
    kind = "bodies" if obj.type in ("body", "xbody") else f"{obj.type}s"
    full_name, offered = find_in_scene(obj, [element.name for element in getattr(spec, kind)])
    if full_name is None:
        raise ValueError(
            f"Sensor {sensor!r} refers to the {obj.type} {obj.name!r}, which "
            f"{f'entity {obj.entity!r}' if obj.entity else 'the scene'} does not have. It has: "
            f"{name_list(offered, near=[obj.name])}."
        )
    return full_name
