"""One simulated thing: its configuration, its part of the scene's spec, and its run-time state."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco

from mjlab.actuator import (
    Actuator,
    ActuatorCfg,
    BuiltinActuatorGroup,
    FusedActuatorGroup,
    TransmissionType,
)
from mjlab.entity.actuation import build_actuators
from mjlab.entity.commands import EntityCommands
from mjlab.entity.data import EntityData
from mjlab.entity.indexing import EntityIndexing as EntityIndexing
from mjlab.entity.indexing import build_indexing
from mjlab.entity.initial_state import add_key, resolve_initial_state, take_keys
from mjlab.entity.initialize import make_data
from mjlab.entity.lookup import Found, NamedElements
from mjlab.entity.options import take_options
from mjlab.entity.state_writer import EnvIds
from mjlab.entity.structure import find_joints, place_body
from mjlab.utils import spec_config as spec_cfg
from mjlab.utils.lab_api.string import resolve_matching_names
from mjlab.utils.spec import auto_wrap_fixed_base_mocap, compile_composed
from mjlab.utils.state import stateful
from mjlab.utils.xml import fix_spec_xml, strip_buffer_textures

if TYPE_CHECKING:
    from mjlab.entity.variants import VariantMetadata


@dataclass
class EntityArticulationInfoCfg:
    """What moves an entity's joints, tendons and sites."""

    actuators: tuple[ActuatorCfg, ...] = ()
    """Actuators to add, or to take from the XML. Actuators of the XML that are not listed stay in
    the model with their control at zero."""
    soft_joint_pos_limit_factor: float = 1.0
    """Size of the soft joint limits as a share of the limits, about the same middle."""


@dataclass
class EntityCfg:
    """Describes an entity: any MuJoCo spec, with a floating or a fixed base, with joints or none.

    An entity with a fixed base is put under a mocap body, so that each environment can place it.
    """

    @dataclass
    class InitialStateCfg:
        """The state that reset events start from, before environment origins are added."""

        pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
        """Position of the root, in metres."""
        rot: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
        """Orientation of the root, as a quaternion (w, x, y, z)."""
        lin_vel: tuple[float, float, float] = (0.0, 0.0, 0.0)
        """Linear velocity of a floating root, in the world frame."""
        ang_vel: tuple[float, float, float] = (0.0, 0.0, 0.0)
        """Angular velocity of a floating root, in the world frame."""
        joint_pos: dict[str, float] | None = field(default_factory=lambda: {".*": 0.0})
        """Joint positions by name pattern. A pattern matches the start of a name, the first that
        does wins, other joints take 0. None takes them from the first keyframe of the XML."""
        joint_vel: dict[str, float] = field(default_factory=lambda: {".*": 0.0})
        """Joint velocities by name pattern, likewise."""

    init_state: InitialStateCfg = field(default_factory=InitialStateCfg)
    """The initial state."""
    spec_fn: Callable[[], mujoco.MjSpec] = field(default_factory=lambda: mujoco.MjSpec)
    """Returns the MuJoCo spec of the entity, which is copied."""
    articulation: EntityArticulationInfoCfg | None = None
    """Actuators and soft joint limits."""
    sort_actuators: bool = False
    """Order actuators by what they act on (joints, tendons, sites) instead of by config."""
    lights: tuple[spec_cfg.LightCfg, ...] = ()
    """Lights to add."""
    cameras: tuple[spec_cfg.CameraCfg, ...] = ()
    """Cameras to add."""
    textures: tuple[spec_cfg.TextureCfg, ...] = ()
    """Textures to add."""
    materials: tuple[spec_cfg.MaterialCfg, ...] = ()
    """Materials to add and to give to geoms."""
    meshes: tuple[spec_cfg.MeshCfg, ...] = ()
    """Changes of mesh assets."""
    geoms: tuple[spec_cfg.GeomCfg, ...] = ()
    """Changes of geoms."""
    collisions: tuple[spec_cfg.CollisionCfg, ...] = ()
    """Collision settings of geoms, applied after `geoms`."""

    def build(self) -> Entity:
        """Build the entity."""
        return Entity(self)


@stateful
class Entity(NamedElements, EntityCommands):
    """A simulated thing. Built from its config alone; `initialize` ties it to a simulation."""

    def __init__(self, cfg: EntityCfg) -> None:
        """Build the entity's spec: the user's, edited, with actuators and initial keyframe.

        Raises:
            ValueError: the spec has several free joints, one that is not its first joint, or ball
                joints; patterns of actuators or editors do not resolve.
        """
        self.cfg = cfg
        spec = self._make_spec()
        self.options = take_options(spec)
        """Simulation options that the entity's own XML asks for; the scene decides on them."""
        xml_key = take_keys(spec)
        self._spec = self._placeable(spec)
        self._spec_to_write = self._spec
        self._free_joint, self._joints = find_joints(self._spec)
        self._data: EntityData | None = None
        self._edit_spec()
        self._actuators = build_actuators(self)
        self.initial_state = resolve_initial_state(
            cfg, self._spec, self._free_joint, self._joints, xml_key
        )
        """The configured initial state, resolved for this entity's joints and actuators."""
        if self._free_joint is None:
            place_body(self.root_body, self.initial_state.root_state)
        add_key(self._spec, [self.initial_state])

    def _make_spec(self) -> mujoco.MjSpec:
        spec = self.cfg.spec_fn()
        if not isinstance(spec, mujoco.MjSpec):
            raise ValueError(
                f"EntityCfg.spec_fn returned {type(spec).__name__}; it must return a "
                "mujoco.MjSpec, such as mujoco.MjSpec.from_file(path)."
            )
        # Editors change it, a scene takes it in, and a function might return one spec twice.
        return spec.copy()

    def _placeable(self, spec: mujoco.MjSpec) -> mujoco.MjSpec:
        """Return `spec` under a mocap body, if its base is fixed."""
        return auto_wrap_fixed_base_mocap(lambda: spec)()

    def _edit_spec(self) -> None:
        cfg = self.cfg
        spec_cfg.warn_overlapping_geom_edits(cfg.geoms, cfg.collisions, self._spec)
        for editors in (
            cfg.lights, cfg.cameras, cfg.textures, cfg.materials, cfg.meshes, cfg.geoms,
            cfg.collisions,
        ):  # fmt: skip
            for editor in editors:
                editor.edit_spec(self._spec)

    # What it is.

    @property
    def spec(self) -> mujoco.MjSpec:
        """The entity's spec. In a scene, its elements carry the prefix of the entity."""
        return self._spec

    @property
    def data(self) -> EntityData:
        """State and targets in all environments.

        Raises:
            RuntimeError: the entity has not been initialized with a simulation.
        """
        if self._data is None:
            raise RuntimeError(
                "This entity has no data yet: call Scene.initialize (or Entity.initialize) with "
                "the compiled model and the simulation first."
            )
        return self._data

    @property
    def indexing(self) -> EntityIndexing:
        """Where the entity's elements are in the model."""
        return self.data.indexing

    @property
    def actuators(self) -> list[Actuator]:
        """The configured actuators."""
        return self._actuators

    @property
    def joints(self) -> tuple[mujoco.MjsJoint, ...]:
        """The joints, without a free joint, in spec order."""
        return self._joints

    @property
    def root_body(self) -> mujoco.MjsBody:
        """The first body; the mocap body that holds everything, where the base is fixed."""
        return self._spec.bodies[1]

    @property
    def is_fixed_base(self) -> bool:
        """Whether the entity has no free joint."""
        return self._free_joint is None

    @property
    def is_articulated(self) -> bool:
        """Whether the entity has joints other than a free one."""
        return bool(self._joints)

    @property
    def is_actuated(self) -> bool:
        """Whether the entity has configured actuators."""
        return bool(self._actuators)

    @property
    def is_mocap(self) -> bool:
        """Whether the root is a mocap body."""
        return bool(self.root_body.mocap)

    @property
    def has_tendon_actuators(self) -> bool:
        """Whether a configured actuator acts on a tendon."""
        return self._acts_on(TransmissionType.TENDON)

    @property
    def has_site_actuators(self) -> bool:
        """Whether a configured actuator acts on a site."""
        return self._acts_on(TransmissionType.SITE)

    def _acts_on(self, transmission: TransmissionType) -> bool:
        return any(actuator.transmission_type == transmission for actuator in self._actuators)

    @property
    def variant_metadata(self) -> VariantMetadata | None:
        """What differs between environments; None unless built from a `VariantEntityCfg`."""
        return None

    @property
    def needs_substep(self) -> bool:
        """Whether an actuator has to act between the physics substeps of one step."""
        return any(actuator.needs_substep for actuator in self._actuators)

    def find_joints_by_actuator_names(self, actuator_name_keys: Any) -> Found:
        """Find joints, in the entity's order, among those that a configured actuator acts on.

        Raises:
            ValueError: a pattern matches none of these joints, or two match one; lists them.
        """
        actuated = {
            name
            for actuator in self._actuators
            if actuator.transmission_type == TransmissionType.JOINT
            for name in actuator.target_names
        }
        names = self.joint_names
        try:
            _, found = resolve_matching_names(
                actuator_name_keys, [name for name in names if name in actuated]
            )
        except ValueError as error:
            raise ValueError(
                f"Cannot find actuated joints by {actuator_name_keys!r}. {error}"
            ) from None
        return [names.index(name) for name in found], found

    # Life cycle.

    def compile(self) -> mujoco.MjModel:
        """Compile the entity alone."""
        return compile_composed(self._spec)

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Tie the entity to a simulation.

        Args:
            mj_model: The compiled model of the scene.
            model: The simulation's model fields.
            data: The simulation's data fields, whose `nworld` is the number of environments.
            device: Torch device of the fields.
        """
        indexing = build_indexing(self._spec, self._free_joint, self.is_actuated, mj_model, device)
        self._data = make_data(self, indexing, model, data, device)
        for actuator in self._actuators:
            actuator.initialize(mj_model, model, data, device)
        self._builtin_group, others = BuiltinActuatorGroup.process(self._actuators)
        self._fused_group, self._own_actuators = FusedActuatorGroup.process(others)
        self._builtin_group.initialize(data.nworld, device)
        self._fused_group.initialize(data.nworld, device)

    def reset(self, env_ids: EnvIds = None) -> None:
        """Set targets to zero and forget delays and histories; the state is left to events."""
        self.data.clear_state(env_ids)
        for actuator in self._actuators:
            actuator.reset(env_ids)

    def clear_state(self, env_ids: EnvIds = None) -> None:
        """Deprecated: call `reset`."""
        warnings.warn(
            "Entity.clear_state is an older name of Entity.reset.", DeprecationWarning, stacklevel=2
        )
        self.reset(env_ids)

    def update(self, dt: float) -> None:
        """Tell the actuators that `dt` seconds have passed."""
        for actuator in self._actuators:
            actuator.update(dt)

    def write_data_to_sim(self, env_ids: EnvIds = None) -> None:
        """Turn targets into controls, through the actuators.

        With `env_ids`, only those environments' controls are written and only their delay lines
        and histories advance: an environment never notices that another one was reset.
        """
        if not self._actuators:
            return
        data = self.data
        self._builtin_group.apply_controls(data, env_ids)
        self._fused_group.apply_controls(data, env_ids)
        for actuator in self._own_actuators:
            actuator.apply_controls(data, env_ids)

    # Files.

    def keep_spec_to_write(self) -> None:
        """Keep a copy of the spec for `write_xml` and `to_zip`. A scene calls this.

        MuJoCo cannot write a spec that has been attached to another one.
        """
        self._spec_to_write = self._spec.copy()

    def write_xml(self, xml_path: Path) -> None:
        """Write the entity's spec as XML, without textures made from raw pixels.

        Of an entity in a scene this is the spec as it was before the scene took it in.
        """
        spec = self._spec_to_write.copy()
        strip_buffer_textures(spec)
        Path(xml_path).write_text(fix_spec_xml(spec.to_xml()))

    def to_zip(self, path: Path) -> None:
        """Write the entity's spec and its assets as MuJoCo's own archive, as `write_xml` does."""
        with open(path, "wb") as file:
            self._spec_to_write.to_zip(file)
