"""The scene: terrain, entities and sensors, composed into one MuJoCo spec."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import mujoco
import torch

from mjlab.entity import Entity, EntityCfg
from mjlab.entity.initial_state import add_key
from mjlab.entity.options import stated_options
from mjlab.scene.base_spec import make_base_spec
from mjlab.scene.options import (
    OptionRequest,
    drop_overridden,
    merge_entity_options,
    report_overruled,
    write_requests,
)
from mjlab.sensor import (
    BuiltinSensor,
    CameraSensor,
    RayCastSensor,
    Sensor,
    SensorCfg,
    SensorContext,
)
from mjlab.sim.engine import Stage
from mjlab.terrains.terrain_entity import TerrainEntity, TerrainEntityCfg
from mjlab.utils.spec import attach, compile_composed, export_spec, make_asset_paths_absolute
from mjlab.utils.state import stateful

if TYPE_CHECKING:
    from mjlab.sim import MujocoCfg

EnvIds = torch.Tensor | slice | None

TERRAIN = "terrain"


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
        if scene_cfg.num_envs < 1:
            raise ValueError(f"SceneCfg.num_envs is {scene_cfg.num_envs}; it has to be at least 1.")
        self._cfg = scene_cfg
        self._device = device
        self._spec = make_base_spec(scene_cfg.extent)
        self._terrain: TerrainEntity | None = None
        self._entities: dict[str, Entity] = {}
        self._sensors: dict[str, Sensor[Any]] = {}
        self._sensor_context: SensorContext | None = None
        self._add_terrain()
        self._add_entities()
        self.entity_options = self._apply_entity_options()
        """Simulation options that entities ask for and nobody in the scene contradicts."""
        self._add_sensors()
        if scene_cfg.spec_fn is not None:
            scene_cfg.spec_fn(self._spec)
            self.entity_options = drop_overridden(self._spec.option, self.entity_options)
        add_key(self._spec, [entity.initial_state for entity in self._entities.values()])
        self._env_origins = torch.zeros(scene_cfg.num_envs, 3, dtype=torch.float32, device=device)

    # Composition.

    def _add_terrain(self) -> None:
        if self._cfg.terrain is None:
            return
        # A copy, because the user's config says what was asked for and stays as it is.
        cfg = dataclasses.replace(
            self._cfg.terrain, num_envs=self._cfg.num_envs, env_spacing=self._cfg.env_spacing
        )
        self._terrain = TerrainEntity(cfg, self._device)
        self._attach(TERRAIN, self._terrain, prefix="")

    def _add_entities(self) -> None:
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
        entity.keep_spec_to_write()
        # MuJoCo would carry the entity's keyframe over, padded with the other entities' qpos0. The
        # scene's own holds the initial state of all.
        for key in list(entity.spec.keys):
            entity.spec.delete(key)
        make_asset_paths_absolute(entity.spec)
        attach(self._spec, entity.spec, prefix, self._spec.worldbody.add_frame())

    def _apply_entity_options(self) -> dict[str, OptionRequest]:
        requests = merge_entity_options(
            {name: entity.options for name, entity in self._entities.items()}
        )
        write_requests(self._spec.option, requests)
        return requests

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
        raise KeyError(
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
