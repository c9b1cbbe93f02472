"""Scenes: terrain, entities and sensors composed into one `MjSpec`.

The fields of `MujocoCfg` override the simulation options in the XML of entities; its flags are
added to those of the XML. Other options come from the XML, unless entities or `SceneCfg.spec_fn`
conflict.
"""

from __future__ import annotations

import dataclasses
import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, get_args

import mujoco
import numpy as np
import torch

from mjlab.entity import Entity, EntityCfg
from mjlab.entity.building import BIT_FIELDS, EntityOptions, add_key, stated_options, write_option
from mjlab.scene.oddities import report_settings, warn_oddities
from mjlab.sensor import (
    BuiltinSensor,
    CameraSensor,
    ContactSensor,
    RayCastSensor,
    Sensor,
    SensorCfg,
    SensorContext,
)
from mjlab.sensor.terrain_scan import check_terrain_scan
from mjlab.sim.config import MujocoCfg
from mjlab.sim.engine import Stage
from mjlab.terrains.terrain_entity import TerrainEntity, TerrainEntityCfg
from mjlab.utils.errors import UnknownNameError, check_count
from mjlab.utils.indexing import EnvIds, as_index
from mjlab.utils.mujoco import OPTION_ENUMS, flag_names
from mjlab.utils.ranges import Range
from mjlab.utils.spec import (
    attach,
    compile_composed,
    drop_references_to_world,
    export_spec,
    make_asset_paths_absolute,
    pop_settings,
)
from mjlab.utils.state import stateful
from mjlab.utils.string import counted, suggest
from mjlab.utils.tables import Table, Tabular, settings_of

TERRAIN = "terrain"

# Options that `MujocoCfg` overrides, and its flags. Flags are added to those of the XML.
_OVERRIDDEN = frozenset(field.name for field in dataclasses.fields(MujocoCfg)) - set(BIT_FIELDS)
_FLAGS = ("disableflags", "enableflags")

# Relative difference of values of standard gravity, such as 9.8, 9.80665 and 9.81 m/s^2.
_GRAVITY_TOLERANCE = 2e-3

logger = logging.getLogger(__name__)


@dataclass(kw_only=True)
class SceneCfg:
    """Scene configuration: terrain, entities, sensors and number of environments."""

    num_envs: int = 1
    """Number of environments."""
    env_spacing: Annotated[float, Range(ends="()")] = 2.0
    """Distance between environment origins on a plane (m)."""
    terrain: TerrainEntityCfg | None = None
    """Terrain. None: no ground, and all environments share the world's origin."""
    entities: dict[str, EntityCfg] = field(default_factory=dict)
    """Entities by name. Scene names of their elements are `<entity>/<element>`."""
    sensors: tuple[SensorCfg, ...] = ()
    """Sensors to add. Sensors in the XML of entities are available as `<entity>/<sensor>`."""
    extent: float | None = None
    """Scene extent for viewers (m). None: computed by MuJoCo."""
    spec_fn: Callable[[mujoco.MjSpec], None] | None = None
    """Function that edits the composed spec before compilation."""


@stateful
class Scene(Tabular):
    """Terrain, entities and sensors composed into one `MjSpec`. `initialize` binds a simulation."""

    _transient = {"_env_origins", "_device", "_updated_sensors", "world_cameras"}

    def __init__(self, scene_cfg: SceneCfg, device: str) -> None:
        """Compose the spec: terrain, entities, sensors, then the config's own edits.

        Raises:
            ValueError: invalid config, entity or sensor.
        """
        check_count("SceneCfg.num_envs", scene_cfg.num_envs)
        self._cfg = scene_cfg
        self._device = device
        self._spec = make_base_spec(scene_cfg.extent)
        self._terrain: TerrainEntity | None = None
        self._entities: dict[str, Entity] = {}
        self._settings: dict[str, dict[str, Any]] = {}
        self._sensors: dict[str, Sensor[Any]] = {}
        self._sensor_context: SensorContext | None = None
        self._add_entities()
        self.entity_options = merge_entity_options(
            {name: entity.options for name, entity in self._entities.items()}
        )
        """Simulation options requested by entities without conflict in the scene."""
        write_requests(self._spec.option, self.entity_options)
        for cfg in scene_cfg.sensors:
            name = cfg.prefixed_name
            if name in self._sensors:
                warnings.warn(
                    f"SceneCfg.sensors: expected unique names, got {name!r} twice; the last one "
                    "replaces the others.",
                    UserWarning,
                    stacklevel=2,
                )
            sensor = cfg.build()
            sensor.edit_spec(self._spec, self._entities)
            self._sensors[name] = sensor
        for mj_sensor in self._spec.sensors:
            # A sensor without a name cannot be looked up.
            if mj_sensor.name and mj_sensor.name not in self._sensors:
                self._sensors[mj_sensor.name] = BuiltinSensor.from_existing(mj_sensor.name)
        # Data of built-in sensors is a live view of the simulation, without a cache to update.
        self._updated_sensors = [
            sensor for sensor in self._sensors.values() if type(sensor) is not BuiltinSensor
        ]
        if scene_cfg.spec_fn is not None:
            scene_cfg.spec_fn(self._spec)
            self.entity_options = drop_overridden(self._spec.option, self.entity_options)
        for name, settings in self._settings.items():
            report_settings(name, settings, self._spec)
        add_key(self._spec, [entity.initial_state for entity in self._entities.values()])
        self._env_origins = torch.zeros(scene_cfg.num_envs, 3, dtype=torch.float32, device=device)
        self._camera_origins = torch.zeros_like(self._env_origins)
        self.world_cameras: list[int] = []
        """Ids of the cameras of camera sensors whose body is the world."""

    # Composition.

    def _add_entities(self) -> None:
        if self._cfg.terrain is not None:
            # A copy, because the user's config must not change.
            terrain_cfg = dataclasses.replace(
                self._cfg.terrain, num_envs=self._cfg.num_envs, env_spacing=self._cfg.env_spacing
            )
            self._terrain = TerrainEntity(terrain_cfg, self._device)
            self._attach(TERRAIN, self._terrain, prefix="")
        for name, cfg in self._cfg.entities.items():
            if not name or "/" in name or name in self._entities:
                warnings.warn(
                    f"Entity name {name!r}: expected a nonempty name without '/', other than "
                    "'terrain' in a scene with a terrain; `scene[name]` is this entity.",
                    UserWarning,
                    stacklevel=3,
                )
            try:
                entity = cfg.build()
            except ValueError as error:
                raise ValueError(f"Entity {name!r}: {error}") from error
            self._attach(name, entity, prefix=f"{name}/")

    def _attach(self, name: str, entity: Entity, prefix: str) -> None:
        self._entities[name] = entity
        entity.snapshot_spec()
        # MuJoCo would copy the entity's keyframe, padded with qpos0 of the other entities. The
        # keyframe of the scene holds the initial state of all entities.
        for key in list(entity.spec.keys):
            entity.spec.delete(key)
        make_asset_paths_absolute(entity.spec)
        self._settings[name] = pop_settings(entity.spec)
        dropped = drop_references_to_world(entity.spec)
        if dropped:
            warnings.warn(
                f"Entity {name!r}: dropped {', '.join(dropped)}, because MuJoCo cannot attach them; "
                "state the world as the second body of an equality, and a body of the entity in "
                "a sensor or an actuator.",
                UserWarning,
                stacklevel=4,
            )
        attach(self._spec, entity.spec, prefix, self._spec.worldbody.add_frame())

    # Access.

    def __repr__(self) -> str:
        names = ", ".join(self._entities)
        return f"<{type(self).__name__}: {names}; {counted(len(self._sensors), 'sensor')}>"

    def tables(self) -> list[Table]:
        """Return the tables of entities and of sensors."""
        entities = [
            (
                name,
                type(entity).__name__,
                "fixed" if entity.is_fixed_base else "floating",
                *(entity.num_bodies, entity.num_joints, entity.num_actuators, entity.num_geoms),
            )
            for name, entity in self._entities.items()
        ]
        parts = {
            f"{sensor.cfg.name}_{primary}"
            for sensor in self._sensors.values()
            if isinstance(sensor, ContactSensor)
            for primary in sensor.primary_names
        }
        sensors = [
            (name, type(sensor).__name__, self._sensor_settings(name))
            for name, sensor in self._sensors.items()
            if name not in parts
        ]
        columns = ("entity", "type", "base", "bodies", "joints", "actuators", "geoms")
        return [
            Table("entities", columns, entities),
            Table("sensors", ("sensor", "type", "settings"), sensors),
        ]

    def _sensor_settings(self, name: str) -> dict[str, Any]:
        """Return the settings of a sensor that are not defaults. Of one in an XML, its type."""
        cfg = getattr(self._sensors[name], "cfg", None)
        if cfg is None:
            return {
                "sensor_type": self._spec.sensor(name).type.name.removeprefix("mjSENS_").lower()
            }
        return settings_of(cfg, "name", "debug", "debug_vis", "viz", changed_only=True)

    def __getitem__(self, key: str) -> Any:
        """Return the sensor, else the entity, with this name. Raises `KeyError` with all names."""
        if key in self._sensors:
            return self._sensors[key]
        if key in self._entities:
            return self._entities[key]
        names = [*self._entities, *self._sensors]
        raise UnknownNameError(f"Unknown entity or sensor {key!r}; {suggest(key, names)}")

    @property
    def cfg(self) -> SceneCfg:
        """Scene configuration."""
        return self._cfg

    @property
    def spec(self) -> mujoco.MjSpec:
        """Composed spec."""
        return self._spec

    @property
    def device(self) -> str:
        """Torch device of all tensors."""
        return self._device

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self._cfg.num_envs

    @property
    def env_spacing(self) -> float:
        """Distance between environment origins on a plane (m)."""
        return self._cfg.env_spacing

    @property
    def env_origins(self) -> torch.Tensor:
        """World positions of the environment origins (m), (N, 3)."""
        return self._env_origins if self._terrain is None else self._terrain.env_origins

    @property
    def terrain(self) -> TerrainEntity | None:
        """Terrain, also available as `entities["terrain"]`."""
        return self._terrain

    @property
    def entities(self) -> dict[str, Entity]:
        """Entities by name, the terrain first."""
        return self._entities

    @property
    def sensors(self) -> dict[str, Sensor[Any]]:
        """Sensors by name."""
        return self._sensors

    @property
    def sensor_context(self) -> SensorContext | None:
        """Context of camera and ray sensors. None without such sensors or before `initialize`."""
        return self._sensor_context

    @property
    def needs_substep(self) -> bool:
        """True if an actuator or a sensor must be updated every physics substep.

        Sensors with `recorded_fields` do not count.
        """
        return any(entity.needs_substep for entity in self._entities.values()) or any(
            sensor.needs_substep and not sensor.recorded_fields for sensor in self._sensors.values()
        )

    @property
    def recorded_fields(self) -> tuple[str, ...]:
        """Data fields to record after every physics substep for sensors."""
        fields = (field for sensor in self._sensors.values() for field in sensor.recorded_fields)
        return tuple(dict.fromkeys(fields))

    def collect_variant_info(self) -> list[Any]:
        """Return name and variant metadata of entities with per-environment meshes."""
        return [
            (name, entity.variant_metadata)
            for name, entity in self._entities.items()
            if entity.variant_metadata is not None
        ]

    def report_overruled_options(self, cfg: MujocoCfg) -> None:
        """Log options of entity XMLs or `spec_fn` that `cfg` overrides with other values.

        `MujocoCfg` overrides every option it has a field for. The scene's spec already has the
        other options and the flags of the XML; the flags of `cfg` are added to them. Flags of an
        XML that are missing in `cfg` are logged too.
        """
        stated = {f"the XML of {name!r}": e.options for name, e in self._entities.items()}
        if self._cfg.spec_fn is not None:
            stated["SceneCfg.spec_fn"] = stated_options(self._spec)
        report_overruled(cfg, stated, self.entity_options)

    def check_terrain_scans(self, mj_model: mujoco.MjModel) -> None:
        """Warn of terrain scans that miss the ground or meet their robot. Call after `initialize`.

        See `check_terrain_scan`.
        """
        for sensor in self._sensors.values():
            if isinstance(sensor, RayCastSensor) and sensor.scans_terrain:
                check_terrain_scan(sensor, mj_model)

    # Life cycle.

    def compile(self) -> mujoco.MjModel:
        """Compile the scene."""
        return compile_composed(self._spec)

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any) -> None:
        """Bind terrain, entities and sensors to a simulation.

        Args:
            mj_model: Model compiled from `spec`.
            model: Model fields of the simulation.
            data: Data fields of the simulation.
        """
        if any(body.id < 0 for body in self._spec.bodies):
            # The model was compiled from a copy of the spec, so unnamed elements have no ids yet.
            compile_composed(self._spec)
        for part in (*self._entities.values(), *self._sensors.values()):
            part.initialize(mj_model, model, data, self._device)
        rays = [sensor for sensor in self._sensors.values() if isinstance(sensor, RayCastSensor)]
        cameras = [sensor for sensor in self._sensors.values() if isinstance(sensor, CameraSensor)]
        ids = {camera.camera_idx for camera in cameras}
        self.world_cameras = sorted(i for i in ids if mj_model.cam_bodyid[i] == 0)
        self._camera_origins.zero_()
        if rays or cameras:
            self._sensor_context = SensorContext(mj_model, model, data, cameras, rays, self._device)
        warn_oddities(self, mj_model)

    def place_cameras(self, model: Any, env_ids: EnvIds = None, *, at_world: bool = False) -> None:
        """Move the world cameras of sensors to the origins of environments.

        Args:
            model: Model fields of the simulation, with per-environment `cam_pos`.
            env_ids: Environments; None for all.
            at_world: Move the cameras back to the origin of the world.
        """
        if not self.world_cameras:
            return
        origins = self.env_origins
        rows = as_index(env_ids)
        places = torch.zeros_like(origins[rows]) if at_world else origins[rows]
        moved = places - self._camera_origins[rows]
        self._camera_origins[rows] = places
        for camera in self.world_cameras:
            model.cam_pos[rows, camera] += moved

    def reset(self, env_ids: EnvIds = None) -> None:
        """Reset targets, delays, histories and sensors of `env_ids` (None: all)."""
        for entity in self._entities.values():
            entity.reset(env_ids)
        for sensor in self._updated_sensors:
            sensor.reset(env_ids)

    def update(
        self, dt: float, recorded: dict[str, torch.Tensor] | None = None, substeps: int = 1
    ) -> None:
        """Update actuators and sensors after `substeps` physics substeps of `dt` seconds each.

        With more than one substep, `recorded` holds `recorded_fields` after each substep.
        """
        for entity in self._entities.values():
            entity.update(substeps * dt)
            entity.data.moved_envs = None
        for sensor in self._updated_sensors:
            if recorded is not None and sensor.recorded_fields:
                sensor.update_recorded(recorded, dt)
            else:
                sensor.update(substeps * dt)

    def write_data_to_sim(self, env_ids: EnvIds = None) -> None:
        """Convert actuator targets into `ctrl`; with `env_ids`, only in environments just reset."""
        for entity in self._entities.values():
            entity.write_data_to_sim(env_ids)

    def take_moved_envs(self) -> torch.Tensor | None:
        """Return environments with an entity placed since the last substep, (N,) bool; forget them.

        None if no entity was placed: see `EntityData.moved_envs`.
        """
        moved = None
        for entity in self._entities.values():
            envs = entity.data.moved_envs
            if envs is not None:
                moved = envs if moved is None else moved | envs
        self.forget_moved_envs()
        return moved

    def forget_moved_envs(self) -> None:
        """Mark no environment as moved: all are up to date."""
        for entity in self._entities.values():
            entity.data.moved_envs = None

    def invalidate_sensor_caches(self, stage: Stage = "acc") -> None:
        """Invalidate cached data of sensors that a forward pass up to `stage` has changed."""
        stages = get_args(Stage)
        for sensor in self._updated_sensors:
            if stages.index(sensor.earliest_stage) <= stages.index(stage):
                sensor.invalidate_cache()

    # Files.

    def write(self, output_dir: Path, *, zip: bool = False) -> None:
        """Write `scene.xml` and its assets into a folder, or into `<output_dir>.zip`."""
        export_spec(self._spec, Path(output_dir), zip=zip)

    def to_zip(self, path: Path) -> None:
        """Deprecated: call `write(path, zip=True)`."""
        warnings.warn(
            "Scene.to_zip is deprecated; use Scene.write(path, zip=True).",
            DeprecationWarning,
            stacklevel=2,
        )
        path = Path(path)
        self.write(path.with_suffix("") if path.suffix == ".zip" else path, zip=True)


def make_base_spec(extent: float | None) -> mujoco.MjSpec:
    """Return a spec without elements or options, with mjlab's visual defaults.

    `extent`: scene extent for viewers (m). None: computed by the compiler.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "mjlab scene"
    visual = spec.visual
    visual.headlight.diffuse[:] = 0.6
    visual.headlight.ambient[:] = 0.3
    visual.headlight.specular[:] = 0.0
    visual.rgba.force[:] = (1.0, 0.0, 0.0, 1.0)
    visual.rgba.haze[:] = (0.15, 0.25, 0.35, 1.0)
    visual.global_.azimuth = 135
    visual.global_.elevation = -25
    visual.global_.offwidth = 1920
    visual.global_.offheight = 1080
    visual.map.force = 0.005
    visual.scale.forcewidth = 0.25
    visual.scale.contactwidth = 0.4
    visual.scale.contactheight = 0.15
    visual.scale.framelength = 5.0
    visual.scale.framewidth = 0.3
    visual.quality.shadowsize = 8192
    spec.stat.meansize = 0.03
    if extent is not None:
        spec.stat.extent = extent
    return spec


# Simulation options in the XML of entities.


@dataclass(frozen=True)
class OptionRequest:
    """Value of a simulation option, and the entities that request it."""

    value: Any
    entities: tuple[str, ...]


def merge_entity_options(options: dict[str, EntityOptions]) -> dict[str, OptionRequest]:
    """Return the options requested by entities, except the fields of `MujocoCfg`.

    Conflicting requests are dropped, with one `UserWarning`. For flags, only the conflicting bits
    are dropped.
    """
    merged: dict[str, OptionRequest] = {}
    conflicts: list[str] = []
    names = dict.fromkeys(name for own in options.values() for name in own.values)
    for name in (name for name in names if name not in _OVERRIDDEN):
        requested = {
            entity: own.values[name] for entity, own in options.items() if name in own.values
        }
        if len(set(requested.values())) == 1:
            merged[name] = OptionRequest(next(iter(requested.values())), tuple(requested))
        else:
            values = ", ".join(f"{show(name, v)} ({entity})" for entity, v in requested.items())
            conflicts.append(f"  {name}: {values}")
    for name in BIT_FIELDS:
        flags = {e: own.switches[name] for e, own in options.items() if name in own.switches}
        enabled = disabled = 0
        for bits, stated in flags.values():
            enabled |= bits
            disabled |= stated & ~bits
        contested = enabled & disabled
        for entity, (bits, stated) in flags.items():
            if stated & contested:
                yes, no = show(name, bits & contested), show(name, stated & ~bits & contested)
                conflicts.append(f"  {name}: {entity} sets {yes} and clears {no}")
        if enabled & ~contested:
            entities = tuple(e for e, (bits, _) in flags.items() if bits & ~contested)
            merged[name] = OptionRequest(enabled & ~contested, entities)
    if conflicts:
        warnings.warn(
            "Conflicting simulation options in the XML of entities are not applied:\n"
            + "\n".join(conflicts)
            + "\nSet flags in MujocoCfg, and other options in SceneCfg.spec_fn.",
            UserWarning,
            stacklevel=3,
        )
    return merged


def write_requests(option: Any, requests: dict[str, OptionRequest]) -> None:
    """Write requests to `option` of the scene's spec."""
    for name, request in requests.items():
        write_option(option, name, request.value)
        logger.info(
            "Option %s = %s, from the XML of %s.",
            name, show(name, request.value), ", ".join(request.entities),
        )  # fmt: skip


def drop_overridden(option: Any, requests: dict[str, OptionRequest]) -> dict[str, OptionRequest]:
    """Return the requests that the scene's `spec_fn` left unchanged; warn about the others."""
    kept, changed = {}, []
    for name, request in requests.items():
        current = getattr(option, name)
        if np.array_equal(current, request.value):
            kept[name] = request
        else:
            changed.append(
                f"  {name}: {show(name, current)} instead of {show(name, request.value)} "
                f"({', '.join(request.entities)})"
            )
    if changed:
        warnings.warn(
            "SceneCfg.spec_fn overrides options from the XML of entities:\n" + "\n".join(changed),
            UserWarning,
            stacklevel=3,
        )
    return kept


def report_overruled(
    cfg: MujocoCfg, stated: dict[str, EntityOptions], requests: dict[str, OptionRequest]
) -> None:
    """Log options that `cfg` overrides, one line each with the assignment to copy.

    Flags that XMLs set in addition to those of `cfg` apply, and are logged too. Gravity of an XML
    that is overridden is a `UserWarning`.

    Args:
        cfg: Options in force.
        stated: Options by source, e.g. "the XML of 'robot'".
        requests: Options of entities that the scene applies.
    """
    for source, options in stated.items():
        for name, value in options.values.items():
            if name not in _OVERRIDDEN:
                continue
            current, wanted = getattr(cfg, name), _config_value(name, value)
            if name == "gravity":
                _report_gravity(source, current, wanted)
            elif not np.array_equal(np.asarray(current), np.asarray(wanted)):
                _report(source, name, current, wanted)
        for name in _FLAGS:
            bits, known = options.switches.get(name, (0, 0))
            current, cleared = tuple(getattr(cfg, name)), flag_names(name, known & ~bits)
            kept = tuple(flag for flag in current if flag not in cleared)
            if kept != current:
                _report(source, name, current, kept)
    for name in (name for name in _FLAGS if name in requests):
        current = tuple(getattr(cfg, name))
        added = [flag for flag in flag_names(name, requests[name].value) if flag not in current]
        setters = {
            source: flag_names(name, stated[source].switches[name][0])
            for source in (f"the XML of {entity!r}" for entity in requests[name].entities)
        }
        if name == "disableflags" and "gravity" in added:
            added.remove("gravity")
            sources = " and ".join(s for s, flags in setters.items() if "gravity" in flags)
            warnings.warn(
                f"Gravity is off in the whole scene, because of {sources}; remove its flag "
                'gravity="disable", or use gravcomp="1" on bodies without weight.',
                UserWarning,
                stacklevel=4,
            )
        if added:
            logger.warning(
                "Option %s is %r, from MujocoCfg, plus %r, from %s (applied to the whole scene); "
                "to configure it, set sim.mujoco.%s = %r",
                name, current, tuple(added),
                " and ".join(source for source in setters if set(setters[source]) & set(added)),
                name, (*current, *added),
            )  # fmt: skip


def _report(source: str, name: str, current: Any, wanted: Any) -> None:
    logger.warning(
        "Option %s is %r, from MujocoCfg; to follow %s, set sim.mujoco.%s = %r",
        name, current, source, name, wanted,
    )  # fmt: skip


def _report_gravity(source: str, current: Any, wanted: Any) -> None:
    """Warn about gravity of an XML that the config overrides; log differences of rounding only."""
    difference = np.linalg.norm(np.subtract(current, wanted))
    if difference > _GRAVITY_TOLERANCE * max(np.linalg.norm(current), np.linalg.norm(wanted)):
        warnings.warn(
            f"Gravity is {tuple(current)} m/s^2, from MujocoCfg, not {wanted} of {source}; to follow "
            f"it, set sim.mujoco.gravity = {wanted}.",
            UserWarning,
            stacklevel=5,
        )
    elif difference > 0.0:
        logger.info("Option gravity is %s, from MujocoCfg, not %s of %s.", current, wanted, source)


def show(name: str, value: Any) -> str:
    """Return an option's value for messages, e.g. enum names instead of numbers."""
    return str(flag_names(name, value) if name in _FLAGS else _config_value(name, value))


def _config_value(name: str, value: Any) -> Any:
    """Convert MuJoCo's value of an option to the format of `MujocoCfg`."""
    if name not in OPTION_ENUMS:
        return tuple(value) if isinstance(value, np.ndarray) else value
    enum, prefix = OPTION_ENUMS[name]
    return enum(int(value)).name.removeprefix(prefix).lower()
