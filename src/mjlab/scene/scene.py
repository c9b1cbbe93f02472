"""The scene: terrain, entities and sensors, composed into one MuJoCo spec.

`MujocoCfg` decides every simulation option that it has a field for, whatever the XML of an entity
says; its flags are added to those of the XML. Other options come from the XML, unless entities or
`SceneCfg.spec_fn` contradict each other.
"""

from __future__ import annotations

import dataclasses
import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import mujoco
import numpy as np
import torch

from mjlab.entity import Entity, EntityCfg
from mjlab.entity.building import BIT_FIELDS, EntityOptions, add_key, stated_options, write_option
from mjlab.sensor import (
    BuiltinSensor,
    CameraSensor,
    RayCastSensor,
    Sensor,
    SensorCfg,
    SensorContext,
)
from mjlab.sim.config import MujocoCfg
from mjlab.sim.engine import Stage
from mjlab.terrains.terrain_entity import TerrainEntity, TerrainEntityCfg
from mjlab.utils.errors import UnknownNameError, check_count
from mjlab.utils.indexing import EnvIds
from mjlab.utils.mujoco import OPTION_ENUMS, flag_names
from mjlab.utils.spec import attach, compile_composed, export_spec, make_asset_paths_absolute
from mjlab.utils.state import stateful

TERRAIN = "terrain"

# Options that `MujocoCfg` decides, and its flags, which are added to those of the XML.
_DECIDED = frozenset(field.name for field in dataclasses.fields(MujocoCfg)) - set(BIT_FIELDS)
_FLAGS = ("disableflags", "enableflags")

logger = logging.getLogger(__name__)


@dataclass(kw_only=True)
class SceneCfg:
    """Describes what is in the world, and in how many environments."""

    num_envs: int = 1
    """Number of environments."""
    env_spacing: float = 2.0
    """Distance between the origins of environments on a plane, in metres."""
    terrain: TerrainEntityCfg | None = None
    """The ground. Without one there is none, and all environments have the same origin."""
    entities: dict[str, EntityCfg] = field(default_factory=dict)
    """Entities by name. In the scene their elements are called `<entity>/<element>`."""
    sensors: tuple[SensorCfg, ...] = ()
    """Sensors to add. Those of the entities' XML are available as `<entity>/<sensor>` anyway."""
    extent: float | None = None
    """Size of the scene for viewers, in metres; None lets MuJoCo compute it."""
    spec_fn: Callable[[mujoco.MjSpec], None] | None = None
    """Edits the scene's spec last, before it is compiled."""


@stateful
class Scene:
    """What is in the world. Built from its config, then tied to a simulation by `initialize`."""

    _transient = {"_env_origins", "_device", "_updated_sensors", "_sensors_by_stage"}

    def __init__(self, scene_cfg: SceneCfg, device: str) -> None:
        """Compose the spec: terrain, entities, sensors, then the config's own edits.

        Raises:
            ValueError: the config makes no sense; entities or sensors cannot be built, or two
                sensors have one name.
        """
        check_count("SceneCfg.num_envs", scene_cfg.num_envs)
        self._cfg = scene_cfg
        self._device = device
        self._spec = make_base_spec(scene_cfg.extent)
        self._terrain: TerrainEntity | None = None
        self._entities: dict[str, Entity] = {}
        self._sensors: dict[str, Sensor[Any]] = {}
        self._sensor_context: SensorContext | None = None
        self._add_entities()
        self.entity_options = merge_entity_options(
            {name: entity.options for name, entity in self._entities.items()}
        )
        """Simulation options that entities ask for and nobody in the scene contradicts."""
        write_requests(self._spec.option, self.entity_options)
        self._add_sensors()
        if scene_cfg.spec_fn is not None:
            scene_cfg.spec_fn(self._spec)
            self.entity_options = drop_overridden(self._spec.option, self.entity_options)
        add_key(self._spec, [entity.initial_state for entity in self._entities.values()])
        self._env_origins = torch.zeros(scene_cfg.num_envs, 3, dtype=torch.float32, device=device)

    # Composition.

    def _add_entities(self) -> None:
        if self._cfg.terrain is not None:
            # A copy, because the user's config says what was asked for and stays as it is.
            terrain_cfg = dataclasses.replace(
                self._cfg.terrain, num_envs=self._cfg.num_envs, env_spacing=self._cfg.env_spacing
            )
            self._terrain = TerrainEntity(terrain_cfg, self._device)
            self._attach(TERRAIN, self._terrain, prefix="")
        for name, cfg in self._cfg.entities.items():
            if not name or "/" in name or name in self._entities:
                raise ValueError(
                    f"Entity name {name!r}: it must be a word without '/', and 'terrain' is taken "
                    "where the scene has a terrain."
                )
            try:
                entity = cfg.build()
            except ValueError as error:
                raise ValueError(f"Entity {name!r}: {error}") from error
            self._attach(name, entity, prefix=f"{name}/")

    def _attach(self, name: str, entity: Entity, prefix: str) -> None:
        self._entities[name] = entity
        entity.snapshot_spec()
        # MuJoCo would carry the entity's keyframe over, padded with the other entities' qpos0. The
        # scene's own holds the initial state of all.
        for key in list(entity.spec.keys):
            entity.spec.delete(key)
        make_asset_paths_absolute(entity.spec)
        attach(self._spec, entity.spec, prefix, self._spec.worldbody.add_frame())

    def _add_sensors(self) -> None:
        for cfg in self._cfg.sensors:
            name = cfg.prefixed_name
            if name in self._sensors:
                raise ValueError(
                    f"Two sensors are called {name!r}. Names must be unique in SceneCfg.sensors: "
                    "rename one of them."
                )
            sensor = cfg.build()
            sensor.edit_spec(self._spec, self._entities)
            self._sensors[name] = sensor
        for mj_sensor in self._spec.sensors:
            # A sensor without a name cannot be asked for.
            if mj_sensor.name and mj_sensor.name not in self._sensors:
                self._sensors[mj_sensor.name] = BuiltinSensor.from_existing(mj_sensor.name)
        # Those of MuJoCo show the simulation itself, and have nothing to keep up to date.
        self._updated_sensors = [
            sensor for sensor in self._sensors.values() if type(sensor) is not BuiltinSensor
        ]
        stages = get_args(Stage)
        self._sensors_by_stage = {
            stage: [
                sensor
                for sensor in self._updated_sensors
                if stages.index(sensor.earliest_stage) <= index
            ]
            for index, stage in enumerate(stages)
        }

    # Access.

    def __getitem__(self, key: str) -> Any:
        """Return the sensor, else the entity, of that name; KeyError lists what there is."""
        if key in self._sensors:
            return self._sensors[key]
        if key in self._entities:
            return self._entities[key]
        raise UnknownNameError(
            f"The scene has no {key!r}. Entities: {list(self._entities)}. "
            f"Sensors: {list(self._sensors)}."
        )

    @property
    def cfg(self) -> SceneCfg:
        """The config the scene was built from."""
        return self._cfg

    @property
    def spec(self) -> mujoco.MjSpec:
        """The composed spec."""
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
        """Distance between environments on a plane, in metres."""
        return self._cfg.env_spacing

    @property
    def env_origins(self) -> torch.Tensor:
        """(N, 3) world positions of the environments' origins."""
        return self._env_origins if self._terrain is None else self._terrain.env_origins

    @property
    def terrain(self) -> TerrainEntity | None:
        """The terrain, which is also `entities["terrain"]`."""
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
        """What evaluates camera and ray sensors, once initialized; None if there are none."""
        return self._sensor_context

    @property
    def needs_substep(self) -> bool:
        """True if an actuator or a sensor acts at every physics substep.

        Sensors with `recorded_fields` do not.
        """
        return any(entity.needs_substep for entity in self._entities.values()) or any(
            sensor.needs_substep and not sensor.recorded_fields for sensor in self._sensors.values()
        )

    @property
    def recorded_fields(self) -> tuple[str, ...]:
        """Data fields of which sensors need the values after every physics substep."""
        fields = (field for sensor in self._sensors.values() for field in sensor.recorded_fields)
        return tuple(dict.fromkeys(fields))

    def collect_variant_info(self) -> list[Any]:
        """Return the entities whose meshes differ between environments."""
        return [
            (name, entity.variant_metadata)
            for name, entity in self._entities.items()
            if entity.variant_metadata is not None
        ]

    def report_overruled_options(self, cfg: MujocoCfg) -> None:
        """Log the options that `cfg` decides otherwise than the XML of an entity, or `spec_fn`.

        `MujocoCfg` decides every option that it has; the others are on `spec.option` since the
        scene was built, as the XML asks, and so are flags, to which those of `cfg` are added. Flags
        of an XML that `cfg` lacks are logged too.
        """
        stated = {f"the XML of {name!r}": e.options for name, e in self._entities.items()}
        if self._cfg.spec_fn is not None:
            stated["SceneCfg.spec_fn"] = stated_options(self._spec)
        report_overruled(cfg, stated, self.entity_options)

    # Life cycle.

    def compile(self) -> mujoco.MjModel:
        """Compile the scene."""
        return compile_composed(self._spec)

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any) -> None:
        """Tie terrain, entities and sensors to a simulation.

        Args:
            mj_model: The model compiled from `spec`.
            model: The simulation's model fields.
            data: The simulation's data fields.
        """
        if any(body.id < 0 for body in self._spec.bodies):
            # The model came from a copy of the spec, so that elements without a name do not know
            # their ids yet.
            compile_composed(self._spec)
        for part in (*self._entities.values(), *self._sensors.values()):
            part.initialize(mj_model, model, data, self._device)
        rays = [sensor for sensor in self._sensors.values() if isinstance(sensor, RayCastSensor)]
        cameras = [sensor for sensor in self._sensors.values() if isinstance(sensor, CameraSensor)]
        if rays or cameras:
            self._sensor_context = SensorContext(mj_model, model, data, cameras, rays, self._device)

    def reset(self, env_ids: EnvIds = None) -> None:
        """Reset targets, delays, histories and sensors of environments; None means all."""
        for entity in self._entities.values():
            entity.reset(env_ids)
        for sensor in self._updated_sensors:
            sensor.reset(env_ids)

    def update(
        self, dt: float, recorded: dict[str, torch.Tensor] | None = None, substeps: int = 1
    ) -> None:
        """Tell actuators and sensors that the simulation has advanced by `substeps` times `dt` s.

        With more than one substep, `recorded` has the values of `recorded_fields` after each.
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
        """Turn the entities' targets into controls; with `env_ids`, only in environments just reset."""
        for entity in self._entities.values():
            entity.write_data_to_sim(env_ids)

    def take_moved_envs(self) -> torch.Tensor | None:
        """Return the environments in which something was placed since the last substep, (N,) bool.

        They are forgotten then. None if nothing was: see `EntityData.moved_envs`.
        """
        moved = None
        for entity in self._entities.values():
            envs, entity.data.moved_envs = entity.data.moved_envs, None
            if envs is not None:
                moved = envs if moved is None else moved | envs
        return moved

    def invalidate_sensor_caches(self, stage: Stage = "acc") -> None:
        """Drop the data of sensors that a forward pass up to `stage` has changed."""
        for sensor in self._sensors_by_stage[stage]:
            sensor.invalidate_cache()

    # Files.

    def write(self, output_dir: Path, *, zip: bool = False) -> None:
        """Write `scene.xml` and the files it refers to into a folder, or `<output_dir>.zip`."""
        export_spec(self._spec, Path(output_dir), zip=zip)

    def to_zip(self, path: Path) -> None:
        """Deprecated: call `write(path, zip=True)`."""
        warnings.warn(
            "Scene.to_zip is an older name of Scene.write(path, zip=True).",
            DeprecationWarning,
            stacklevel=2,
        )
        path = Path(path)
        self.write(path.with_suffix("") if path.suffix == ".zip" else path, zip=True)


def make_base_spec(extent: float | None) -> mujoco.MjSpec:
    """Return a spec without elements or options, with mjlab's visual defaults.

    `extent` is the size of the scene for viewers, in metres; None lets the compiler compute it.
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
    """A value for a simulation option, and the entities that ask for it."""

    value: Any
    entities: tuple[str, ...]


def merge_entity_options(options: dict[str, EntityOptions]) -> dict[str, OptionRequest]:
    """Return what the entities ask for together, beyond what `MujocoCfg` decides.

    Fields about which entities disagree are left out, and reported by one `UserWarning`. Of sets of
    switches (flags), only the switches are left out about which they disagree.
    """
    merged: dict[str, OptionRequest] = {}
    conflicts: list[str] = []
    names = dict.fromkeys(name for own in options.values() for name in own.values)
    for name in (name for name in names if name not in _DECIDED):
        wishes = {entity: own.values[name] for entity, own in options.items() if name in own.values}
        if len(set(wishes.values())) == 1:
            merged[name] = OptionRequest(next(iter(wishes.values())), tuple(wishes))
        else:
            wanted = ", ".join(f"{show(name, v)} ({entity})" for entity, v in wishes.items())
            conflicts.append(f"  {name}: {wanted}")
    for name in BIT_FIELDS:
        _merge_switches(name, options, merged, conflicts)
    if conflicts:
        warnings.warn(
            "Entities ask in their XML for different simulation options. A scene has one of each, "
            "so these are not applied:\n" + "\n".join(conflicts) + "\nSet flags in MujocoCfg, and "
            "the others in SceneCfg.spec_fn.",
            UserWarning,
            stacklevel=3,
        )
    return merged


def _merge_switches(
    name: str,
    options: dict[str, EntityOptions],
    merged: dict[str, OptionRequest],
    conflicts: list[str],
) -> None:
    wishes = {e: own.switches[name] for e, own in options.items() if name in own.switches}
    wanted = unwanted = 0
    for bits, stated in wishes.values():
        wanted |= bits
        unwanted |= stated & ~bits
    contested = wanted & unwanted
    for entity, (bits, stated) in wishes.items():
        if stated & contested:
            yes, no = show(name, bits & contested), show(name, stated & ~bits & contested)
            conflicts.append(f"  {name}: {entity} sets {yes} and clears {no}")
    if wanted & ~contested:
        entities = tuple(e for e, (bits, _) in wishes.items() if bits & ~contested)
        merged[name] = OptionRequest(wanted & ~contested, entities)


def write_requests(option: Any, requests: dict[str, OptionRequest]) -> None:
    """Write requests onto the option block of the scene's spec."""
    for name, request in requests.items():
        write_option(option, name, request.value)
        logger.info(
            "Option %s = %s, as the XML of %s asks.",
            name, show(name, request.value), ", ".join(request.entities),
        )  # fmt: skip


def drop_overridden(option: Any, requests: dict[str, OptionRequest]) -> dict[str, OptionRequest]:
    """Return the requests that the scene's `spec_fn` left as they were; report the others."""
    kept, changed = {}, []
    for name, request in requests.items():
        current = getattr(option, name)
        if np.array_equal(current, request.value):
            kept[name] = request
        else:
            changed.append(
                f"  {name}: {show(name, current)}, not {show(name, request.value)} as "
                f"{', '.join(request.entities)}"
            )
    if changed:
        warnings.warn(
            "SceneCfg.spec_fn sets options otherwise than the XML of an entity asks:\n"
            + "\n".join(changed),
            UserWarning,
            stacklevel=3,
        )
    return kept


def report_overruled(
    cfg: MujocoCfg, stated: dict[str, EntityOptions], requests: dict[str, OptionRequest]
) -> None:
    """Log what `cfg` decides otherwise than XMLs state, one line each with the assignment to copy.

    Flags that XMLs set in addition to those of `cfg` apply, and are logged too.

    Args:
        cfg: The options that are in force.
        stated: Options by where they are stated, such as "the XML of 'robot'".
        requests: Options of entities that are applied to the scene.
    """
    for source, options in stated.items():
        for name, value in options.values.items():
            if name not in _DECIDED:
                continue
            current, wanted = getattr(cfg, name), _config_value(name, value)
            if not np.array_equal(np.asarray(current), np.asarray(wanted)):
                _report(source, name, current, wanted)
        for name in _FLAGS:
            bits, known = options.switches.get(name, (0, 0))
            current, cleared = tuple(getattr(cfg, name)), flag_names(name, known & ~bits)
            kept = tuple(flag for flag in current if flag not in cleared)
            if kept != current:
                _report(source, name, current, kept)
    for name in (name for name in _FLAGS if name in requests):
        current = tuple(getattr(cfg, name))
        added = tuple(
            flag for flag in flag_names(name, requests[name].value) if flag not in current
        )
        if added:
            sources = [f"the XML of {entity!r}" for entity in requests[name].entities]
            adding = [
                s
                for s in sources
                if set(flag_names(name, stated[s].switches[name][0])) & set(added)
            ]
            logger.warning(
                "Option %s is %r, from MujocoCfg, plus %r, from %s, which applies to the whole "
                "scene; to state it in the config, set sim.mujoco.%s = %r",
                name, current, added, " and ".join(adding), name, current + added,
            )  # fmt: skip


def _report(source: str, name: str, current: Any, wanted: Any) -> None:
    logger.warning(
        "Option %s is %r, from MujocoCfg; to follow %s, set sim.mujoco.%s = %r",
        name, current, source, name, wanted,
    )  # fmt: skip


def show(name: str, value: Any) -> str:
    """Return an option's value as people write it."""
    return str(flag_names(name, value) if name in _FLAGS else _config_value(name, value))


def _config_value(name: str, value: Any) -> Any:
    """Return MuJoCo's value of an option as `MujocoCfg` gives it."""
    if name not in OPTION_ENUMS:
        return tuple(value) if isinstance(value, np.ndarray) else value
    enum, prefix = OPTION_ENUMS[name]
    return enum(int(value)).name.removeprefix(prefix).lower()
