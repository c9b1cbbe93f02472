"""Entities: configuration, MuJoCo spec, and run-time state of robots and objects."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import torch

from mjlab.actuator.actuator import Actuator, ActuatorCfg, TransmissionType
from mjlab.actuator.builtin_group import BuiltinActuatorGroup
from mjlab.actuator.fused_group import FusedActuatorGroup
from mjlab.actuator.position_hold import PositionHold
from mjlab.actuator.xml_actuator import XML_TRANSMISSIONS
from mjlab.compat import suggests_attributes, suggests_fields
from mjlab.entity.building import (
    KEY_NAME,
    Found,
    add_key,
    build_actuators,
    copy_spec,
    find_joints,
    find_names,
    place_body,
    pop_keyframes,
    pop_options,
    resolve_initial_state,
    scale_to_total_mass,
    short_names,
)
from mjlab.entity.data import EntityData, as_values, assign
from mjlab.entity.indexing import EntityIndexing as EntityIndexing
from mjlab.entity.indexing import Ids, build_indexing
from mjlab.sim.randomization import VariantInfo
from mjlab.utils import spec_config as spec_cfg
from mjlab.utils.errors import WrongStateError
from mjlab.utils.indexing import EnvIds, as_ids, as_index
from mjlab.utils.spec import auto_wrap_fixed_base_mocap, compile_composed
from mjlab.utils.state import stateful
from mjlab.utils.xml import fix_spec_xml, strip_buffer_textures


@dataclass
class EntityArticulationInfoCfg:
    """Actuators and soft joint limits."""

    actuators: tuple[ActuatorCfg, ...] = ()
    """Actuators to add, or to take over from the XML. XML actuators that no config lists stay in
    the model. After a reset, position actuators among them hold their length, and others have zero
    control; with a keyframe as initial state, both have its control."""
    soft_joint_pos_limit_factor: float = 1.0
    """Range of the soft joint limits as a fraction of the joint range, about the same center."""


@suggests_fields
@dataclass
class EntityCfg:
    """Entity configuration: any MuJoCo spec, with floating or fixed base, with or without joints.

    A fixed base is attached to a mocap body, so that each environment can place it.
    """

    @dataclass
    class InitialStateCfg:
        """Initial state, used by reset events. Environment origins are added later."""

        pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
        """Root position (m)."""
        rot: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
        """Root orientation, quaternion (w, x, y, z)."""
        lin_vel: tuple[float, float, float] = (0.0, 0.0, 0.0)
        """Linear velocity of a floating root (m/s), world frame."""
        ang_vel: tuple[float, float, float] = (0.0, 0.0, 0.0)
        """Angular velocity of a floating root (rad/s), world frame."""
        joint_pos: dict[str, float] | None = field(default_factory=lambda: {".*": 0.0})
        """Joint positions (rad or m) by name pattern. Patterns match at the start of a name, the
        first match wins, other joints get 0. None: joint positions of the first XML keyframe."""
        joint_vel: dict[str, float] = field(default_factory=lambda: {".*": 0.0})
        """Joint velocities (rad/s or m/s) by name pattern, matched as in `joint_pos`."""

    init_state: InitialStateCfg = field(default_factory=InitialStateCfg)
    """Initial state."""
    spec_fn: Callable[[], mujoco.MjSpec] = field(default_factory=lambda: mujoco.MjSpec)
    """Function that returns the entity's MuJoCo spec. The spec is copied."""
    articulation: EntityArticulationInfoCfg | None = None
    """Actuators and soft joint limits."""
    sort_actuators: bool = False
    """Order actuators by target (joints, tendons, sites) instead of by config."""
    lights: tuple[spec_cfg.LightCfg, ...] = ()
    """Lights to add."""
    cameras: tuple[spec_cfg.CameraCfg, ...] = ()
    """Cameras to add."""
    textures: tuple[spec_cfg.TextureCfg, ...] = ()
    """Textures to add."""
    materials: tuple[spec_cfg.MaterialCfg, ...] = ()
    """Materials to add and assign to geoms."""
    meshes: tuple[spec_cfg.MeshCfg, ...] = ()
    """Edits of mesh assets."""
    geoms: tuple[spec_cfg.GeomCfg, ...] = ()
    """Edits of geoms."""
    collisions: tuple[spec_cfg.CollisionCfg, ...] = ()
    """Collision settings of geoms, applied after `geoms`."""

    def build(self) -> Entity:
        """Build the entity."""
        return Entity(self)


@suggests_attributes
@stateful
class Entity:
    """Simulated robot or object. Built from its config; `initialize` binds it to a simulation.

    Names omit the scene prefix: they are the part after the last "/". Unnamed elements are called
    "". Every `find_*` takes regular expressions that must match a whole name, and returns indices
    within the entity and names, in entity order, or, with `preserve_order`, pattern by pattern. With
    a subset of names to choose from, indices count within that subset. `find_*` raises `ValueError`,
    listing the candidates, if a pattern matches nothing or two patterns match one name.

    `env_ids` of setters and writers is None (all), a slice, a boolean mask or a 1-D tensor of
    indices; element ids count within the entity and may also be a list. If both are tensors, they
    select their product. Values are tensors or arrays of any float type. Setters and writers raise
    `ValueError` if a width is wrong or the entity has no such elements. Setters store a target for the
    next `write_data_to_sim`; writers change the simulation immediately, and derived quantities follow
    at the next `sim.forward()`.
    """

    def __init__(self, cfg: EntityCfg) -> None:
        """Build the entity's spec: user spec, editors, actuators, initial keyframe.

        Raises:
            ValueError: the spec has several free joints; patterns of actuators or editors do not
                resolve.
        """
        self.cfg = cfg
        spec = self._make_spec()
        scale_to_total_mass(spec)
        self.options = pop_options(spec)
        """Simulation options stated in the entity's XML. The scene decides whether to apply them."""
        self.xml_key = pop_keyframes(spec)
        """First keyframe of the entity's XML."""
        self._spec = self._placeable(spec)
        self._spec_to_write = self._spec
        self._free_joint, self._joints = find_joints(self._spec)
        self._data: EntityData | None = None
        spec_cfg.warn_overlapping_geom_edits(cfg.geoms, cfg.collisions, self._spec)
        for editors in (
            cfg.lights, cfg.cameras, cfg.textures, cfg.materials, cfg.meshes, cfg.geoms,
            cfg.collisions,
        ):  # fmt: skip
            for editor in editors:
                editor.edit_spec(self._spec)
        self._actuators = build_actuators(
            () if cfg.articulation is None else cfg.articulation.actuators,
            self._spec,
            self._joints,
            lambda actuator, ids, names: actuator.build(self, ids, names),
            cfg.sort_actuators,
        )
        self._updated_actuators = [
            actuator for actuator in self._actuators if type(actuator).update is not Actuator.update
        ]
        self._writers: list[Any] = []
        self.initial_state = resolve_initial_state(
            self._spec, self._free_joint, self._joints, self.xml_key, cfg.init_state
        )
        """Configured initial state, resolved for this entity's joints and actuators."""
        if self._free_joint is None:
            place_body(self.root_body, self.initial_state.root_state)
        add_key(self._spec, [self.initial_state])

    def _make_spec(self) -> mujoco.MjSpec:
        return copy_spec(self.cfg.spec_fn(), "EntityCfg.spec_fn")

    def _placeable(self, spec: mujoco.MjSpec) -> mujoco.MjSpec:
        """Return `spec`, attached to a mocap body if its base is fixed."""
        return auto_wrap_fixed_base_mocap(lambda: spec)()

    # Properties.

    @property
    def spec(self) -> mujoco.MjSpec:
        """MuJoCo spec. In a scene, element names carry the entity's prefix."""
        return self._spec

    @property
    def data(self) -> EntityData:
        """State and targets of all environments.

        Raises:
            RuntimeError: the entity has not been initialized with a simulation.
        """
        if self._data is None:
            raise WrongStateError(
                "Entity.data: expected an initialized entity; call Scene.initialize (or "
                "Entity.initialize) with the compiled model and the simulation first."
            )
        return self._data

    @property
    def indexing(self) -> EntityIndexing:
        """Ids and addresses of the entity's elements in the model."""
        return self.data.indexing

    @property
    def actuators(self) -> list[Actuator]:
        """Configured actuators."""
        return self._actuators

    @property
    def joints(self) -> tuple[mujoco.MjsJoint, ...]:
        """Hinges and slides in spec order."""
        return self._joints

    @property
    def root_body(self) -> mujoco.MjsBody:
        """Root body: the body of the free joint; for a fixed base, the mocap body."""
        return self._spec.bodies[1] if self._free_joint is None else self._free_joint.parent

    @property
    def is_fixed_base(self) -> bool:
        """True if the entity has no free joint."""
        return self._free_joint is None

    @property
    def is_articulated(self) -> bool:
        """True if the entity has joints other than a free joint."""
        return bool(self._joints)

    @property
    def is_actuated(self) -> bool:
        """True if the entity has configured actuators."""
        return bool(self._actuators)

    @property
    def is_mocap(self) -> bool:
        """True if the root is a mocap body."""
        return bool(self.root_body.mocap)

    @property
    def has_tendon_actuators(self) -> bool:
        """True if a configured actuator acts on a tendon."""
        return TransmissionType.TENDON in {one.transmission_type for one in self._actuators}

    @property
    def has_site_actuators(self) -> bool:
        """True if a configured actuator acts on a site."""
        return TransmissionType.SITE in {one.transmission_type for one in self._actuators}

    @property
    def seeds_lengths(self) -> bool:
        """True if `seed_position_targets` reads lengths of tendons or actuators."""
        return self.has_tendon_actuators or bool(self._position_hold)

    @property
    def variant_metadata(self) -> VariantInfo | None:
        """Variants and their assignment; None unless built from a `VariantEntityCfg`."""
        return None

    @property
    def needs_substep(self) -> bool:
        """True if an actuator must act at every physics substep of an environment step."""
        return any(actuator.needs_substep for actuator in self._actuators)

    # Life cycle.

    def compile(self) -> mujoco.MjModel:
        """Compile the entity alone."""
        return compile_composed(self._spec)

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """Bind the entity to a simulation.

        Args:
            mj_model: Compiled model of the scene.
            model: Model fields of the simulation.
            data: Data fields of the simulation; `nworld` is the number of environments.
            device: Torch device of the fields.
        """
        indexing = build_indexing(self._spec, self._free_joint, self.is_actuated, mj_model, device)
        self._data = _make_data(self, indexing, model, data, device)
        for actuator in self._actuators:
            actuator.initialize(mj_model, model, data, device)
        builtin, others = BuiltinActuatorGroup.process(self._actuators)
        fused, others = FusedActuatorGroup.process(others)
        for group in (builtin, fused):
            group.initialize(data.nworld, device)
        self._writers = [*builtin.writers, *fused.writers, *others]
        ids = [actuator.id for actuator in self._spec.actuators]
        listed = {i for one in self._actuators for i in one.global_element_ids.tolist()}
        uses_key = self.xml_key is not None and self.cfg.init_state.joint_pos is None
        keyframe = mj_model.key(KEY_NAME).ctrl if uses_key else None
        self._position_hold = PositionHold(mj_model, data, ids, {*ids} - listed, keyframe, device)
        if self.has_tendon_actuators:
            # Engines compute a field after its first access.
            _ = self._data.tendon_len

    def reset(self, env_ids: EnvIds = None) -> None:
        """Set targets to zero and clear delays and histories. Reset events write the state."""
        self.data.clear_state(env_ids)
        for actuator in self._actuators:
            actuator.reset(env_ids)

    def clear_state(self, env_ids: EnvIds = None) -> None:
        """Deprecated: call `reset`."""
        warnings.warn(
            "Entity.clear_state is deprecated; use Entity.reset.", DeprecationWarning, stacklevel=2
        )
        self.reset(env_ids)

    def update(self, dt: float) -> None:
        """Update the actuators after a physics substep of `dt` seconds."""
        for actuator in self._updated_actuators:
            actuator.update(dt)

    def write_data_to_sim(self, env_ids: EnvIds = None) -> None:
        """Convert targets to controls through the actuators and write `ctrl`.

        With `env_ids`, only the controls, delay lines and histories of these environments change:
        a partial reset does not affect other environments.
        """
        for writer in self._writers:
            writer.apply_controls(self.data, env_ids)

    # Element names.

    @property
    def body_names(self) -> tuple[str, ...]:
        """Names of the bodies, without the world."""
        return short_names(self._spec.bodies[1:])

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the hinges and slides."""
        return short_names(self._joints)

    @property
    def all_joint_names(self) -> tuple[str, ...]:
        """Names of all joints, with a free joint and ball joints."""
        return short_names(self._spec.joints)

    @property
    def geom_names(self) -> tuple[str, ...]:
        """Names of the geoms."""
        return short_names(self._spec.geoms)

    @property
    def site_names(self) -> tuple[str, ...]:
        """Names of the sites."""
        return short_names(self._spec.sites)

    @property
    def tendon_names(self) -> tuple[str, ...]:
        """Names of the tendons."""
        return short_names(self._spec.tendons)

    @property
    def actuator_names(self) -> tuple[str, ...]:
        """Names of all actuators in the spec, unlisted XML actuators included."""
        return short_names(self._spec.actuators)

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return short_names(self._spec.cameras)

    @property
    def light_names(self) -> tuple[str, ...]:
        """Names of the lights."""
        return short_names(self._spec.lights)

    @property
    def material_names(self) -> tuple[str, ...]:
        """Names of the materials."""
        return short_names(self._spec.materials)

    @property
    def texture_names(self) -> tuple[str, ...]:
        """Names of the textures."""
        return short_names(self._spec.textures)

    @property
    def pair_names(self) -> tuple[str, ...]:
        """Names of the contact pairs."""
        return short_names(self._spec.pairs)

    # Owners of elements.

    @property
    def actuator_joints(self) -> list[int | None]:
        """Index of the joint that each actuator acts on, or None. Empty without configured actuators."""
        joints = {joint.name: index for index, joint in enumerate(self._joints)}
        on_joint = XML_TRANSMISSIONS[TransmissionType.JOINT]
        return [
            joints.get(actuator.target) if actuator.trntype in on_joint else None
            for actuator in (self._spec.actuators if self.is_actuated else ())
        ]

    @property
    def geom_bodies(self) -> list[int | None]:
        """Index of the body of each geom; None for the world."""
        bodies = {body: index for index, body in enumerate(self._spec.bodies[1:])}
        return [bodies.get(geom.parent) for geom in self._spec.geoms]

    # Element counts.

    @property
    def num_bodies(self) -> int:
        """Number of bodies, without the world."""
        return len(self.body_names)

    @property
    def num_joints(self) -> int:
        """Number of hinges and slides."""
        return len(self._joints)

    @property
    def num_geoms(self) -> int:
        """Number of geoms."""
        return len(self.geom_names)

    @property
    def num_sites(self) -> int:
        """Number of sites."""
        return len(self.site_names)

    @property
    def num_tendons(self) -> int:
        """Number of tendons."""
        return len(self.tendon_names)

    @property
    def num_actuators(self) -> int:
        """Number of actuators in the spec."""
        return len(self.actuator_names)

    @property
    def num_cameras(self) -> int:
        """Number of cameras."""
        return len(self.camera_names)

    @property
    def num_lights(self) -> int:
        """Number of lights."""
        return len(self.light_names)

    @property
    def num_materials(self) -> int:
        """Number of materials."""
        return len(self.material_names)

    @property
    def num_textures(self) -> int:
        """Number of textures."""
        return len(self.texture_names)

    @property
    def num_pairs(self) -> int:
        """Number of contact pairs."""
        return len(self.pair_names)

    # Name lookups.

    def find_bodies(self, name_keys: str | Sequence[str], preserve_order: bool = False) -> Found:
        """Find bodies by name."""
        return find_names("bodies", name_keys, self.body_names, preserve_order=preserve_order)

    def find_joints(
        self,
        name_keys: str | Sequence[str],
        joint_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find joints by name, a free joint excluded."""
        return find_names("joints", name_keys, self.joint_names, joint_subset, preserve_order)

    def find_geoms(
        self,
        name_keys: str | Sequence[str],
        geom_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find geoms by name."""
        return find_names("geoms", name_keys, self.geom_names, geom_subset, preserve_order)

    def find_sites(
        self,
        name_keys: str | Sequence[str],
        site_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find sites by name."""
        return find_names("sites", name_keys, self.site_names, site_subset, preserve_order)

    def find_tendons(
        self,
        name_keys: str | Sequence[str],
        tendon_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find tendons by name."""
        return find_names("tendons", name_keys, self.tendon_names, tendon_subset, preserve_order)

    def find_actuators(
        self,
        name_keys: str | Sequence[str],
        actuator_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find actuators by name."""
        return find_names(
            "actuators", name_keys, self.actuator_names, actuator_subset, preserve_order
        )

    def find_cameras(
        self,
        name_keys: str | Sequence[str],
        camera_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find cameras by name."""
        return find_names("cameras", name_keys, self.camera_names, camera_subset, preserve_order)

    def find_lights(
        self,
        name_keys: str | Sequence[str],
        light_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find lights by name."""
        return find_names("lights", name_keys, self.light_names, light_subset, preserve_order)

    def find_materials(
        self,
        name_keys: str | Sequence[str],
        material_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find materials by name."""
        return find_names(
            "materials", name_keys, self.material_names, material_subset, preserve_order
        )

    def find_textures(
        self,
        name_keys: str | Sequence[str],
        texture_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find textures by name."""
        return find_names("textures", name_keys, self.texture_names, texture_subset, preserve_order)

    def find_pairs(
        self,
        name_keys: str | Sequence[str],
        pair_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
    ) -> Found:
        """Find contact pairs by name."""
        return find_names("pairs", name_keys, self.pair_names, pair_subset, preserve_order)

    def find_joints_by_actuator_names(self, actuator_name_keys: Any) -> Found:
        """Find joints, in entity order, among the joints driven by configured actuators.

        Raises:
            ValueError: a pattern matches none of these joints, or two patterns match one joint;
                lists the joints.
        """
        actuated = {
            name
            for actuator in self._actuators
            if actuator.transmission_type == TransmissionType.JOINT
            for name in actuator.target_names
        }
        names = self.joint_names
        candidates = [name for name in names if name in actuated]
        _, found = find_names("actuated joints", actuator_name_keys, candidates)
        return [names.index(name) for name in found], found

    # Actuator targets.

    def set_joint_position_target(
        self, position: torch.Tensor, joint_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set position targets (rad or m), (k, number of joints)."""
        _set_target(self.data.joint_pos_target, position, joint_ids, env_ids, "joint")

    def set_joint_velocity_target(
        self, velocity: torch.Tensor, joint_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set velocity targets (rad/s or m/s), (k, number of joints)."""
        _set_target(self.data.joint_vel_target, velocity, joint_ids, env_ids, "joint")

    def set_joint_effort_target(
        self, effort: torch.Tensor, joint_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set effort targets (N m or N), (k, number of joints)."""
        _set_target(self.data.joint_effort_target, effort, joint_ids, env_ids, "joint")

    def set_tendon_len_target(
        self, length: torch.Tensor, tendon_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set length targets, (k, number of tendons)."""
        _set_target(self.data.tendon_len_target, length, tendon_ids, env_ids, "tendon")

    def set_tendon_vel_target(
        self, velocity: torch.Tensor, tendon_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set velocity targets, (k, number of tendons)."""
        _set_target(self.data.tendon_vel_target, velocity, tendon_ids, env_ids, "tendon")

    def set_tendon_effort_target(
        self, effort: torch.Tensor, tendon_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set effort targets, (k, number of tendons)."""
        _set_target(self.data.tendon_effort_target, effort, tendon_ids, env_ids, "tendon")

    def set_site_effort_target(
        self, effort: torch.Tensor, site_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set effort targets, (k, number of sites)."""
        _set_target(self.data.site_effort_target, effort, site_ids, env_ids, "site")

    def seed_position_targets(self, env_ids: EnvIds = None) -> None:
        """Set position targets that are unset since the reset to the current positions and lengths.

        A reset sets all targets to zero, so position actuators would pull toward zero until the
        first action. Called after the reset events, this holds joints and tendons where the events
        placed them, and sets the controls of XML actuators without a config. With
        `seeds_lengths`, `sim.forward(env_ids, stage="pos")` must precede.
        """
        rows = as_index(env_ids)
        for target, current in (
            (self.data.joint_pos_target, "joint_pos"),
            (self.data.tendon_len_target, "tendon_len"),
        ):
            if target.shape[1] > 0:
                chosen = target[rows]
                target[rows] = torch.where(chosen == 0.0, getattr(self.data, current)[rows], chosen)
        if self._position_hold:
            self._position_hold.apply(env_ids)

    # State writers.

    def write_root_state_to_sim(self, root_state: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write the root link's pose and velocity, (k, 13)."""
        self.data.write_root_state(root_state, env_ids)

    def write_root_link_pose_to_sim(self, root_pose: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write the root link's world pose, (k, 7): position, quaternion (w, x, y, z)."""
        self.data.write_root_pose(root_pose, env_ids)

    def write_root_link_velocity_to_sim(
        self, root_velocity: torch.Tensor, env_ids: EnvIds = None
    ) -> None:
        """Write the root link's world velocity, (k, 6). Write the pose first."""
        self.data.write_root_velocity(root_velocity, env_ids)

    def write_root_link_velocity_b_to_sim(
        self, root_velocity_b: torch.Tensor, env_ids: EnvIds = None
    ) -> None:
        """Write the root link's velocity in the link frame, (k, 6). Write the pose first."""
        self.data.write_root_velocity_b(root_velocity_b, env_ids)

    def write_root_com_velocity_to_sim(
        self, root_velocity: torch.Tensor, env_ids: EnvIds = None
    ) -> None:
        """Write the root body's center-of-mass velocity, world frame, (k, 6). Write the pose first."""
        self.data.write_root_com_velocity(root_velocity, env_ids)

    def write_joint_state_to_sim(
        self,
        position: torch.Tensor,
        velocity: torch.Tensor,
        joint_ids: Ids = None,
        env_ids: EnvIds = None,
    ) -> None:
        """Write joint positions and velocities, (k, number of joints), or (k, 1) to broadcast."""
        self.data.write_joint_state(position, velocity, joint_ids, env_ids)

    def write_joint_position_to_sim(
        self, position: torch.Tensor, joint_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Write joint positions, (k, number of joints), or (k, 1) to broadcast."""
        self.data.write_joint_position(position, joint_ids, env_ids)

    def write_joint_velocity_to_sim(
        self, velocity: torch.Tensor, joint_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Write joint velocities, (k, number of joints), or (k, 1) to broadcast."""
        self.data.write_joint_velocity(velocity, joint_ids, env_ids)

    def write_external_wrench_to_sim(
        self,
        forces: torch.Tensor | None,
        torques: torch.Tensor | None,
        env_ids: EnvIds = None,
        body_ids: Sequence[int] | torch.Tensor | slice | None = None,
    ) -> None:
        """Set world force and torque at the bodies' centers of mass, (k, number of bodies, 3)."""
        self.data.write_external_wrench(forces, torques, body_ids, env_ids)

    def write_ctrl_to_sim(
        self, ctrl: torch.Tensor, ctrl_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Write controls of actuators `ctrl_ids` (see `find_actuators`), (k, number of controls).

        See `EntityData.write_ctrl` for actuators with several controls.
        """
        self.data.write_ctrl(ctrl, ctrl_ids, env_ids)

    def write_mocap_pose_to_sim(self, mocap_pose: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write the pose of the mocap root, (k, 7): position, quaternion (w, x, y, z)."""
        self.data.write_mocap_pose(mocap_pose, env_ids)

    # Export.

    def snapshot_spec(self) -> None:
        """Copy the spec for `write_xml` and `to_zip`. Called by the scene before attaching the entity.

        MuJoCo cannot export a spec that has been attached to another one.
        """
        self._spec_to_write = self._spec.copy()

    def write_xml(self, xml_path: Path) -> None:
        """Write the entity's spec as XML, without textures built from raw pixels.

        For an entity in a scene, this is the spec before it was attached.
        """
        spec = self._spec_to_write.copy()
        strip_buffer_textures(spec)
        Path(xml_path).write_text(fix_spec_xml(spec.to_xml()), encoding="utf-8")

    def to_zip(self, path: Path) -> None:
        """Write the entity's spec and assets as a MuJoCo zip archive; see `write_xml`."""
        with open(path, "wb") as file:
            self._spec_to_write.to_zip(file)


def _set_target(
    target: torch.Tensor, value: torch.Tensor, ids: Ids, env_ids: EnvIds, kind: str
) -> None:
    width = target.shape[1]
    if width == 0 and torch.as_tensor(value).numel() > 0:
        raise ValueError(
            f"Entity has no {kind} targets: it has no {kind}s"
            + ("." if kind == "joint" else f", or no configured actuator acts on a {kind}.")
        )
    columns: slice | torch.Tensor
    if ids is None:
        columns = slice(None)
    elif isinstance(ids, slice):
        columns, width = ids, len(range(*ids.indices(width)))
    else:
        columns = as_ids(ids, width, target.device)
        width = columns.shape[0]
    values = as_values(value, width, f"{kind} target", str(target.device), broadcasts=True)
    assign(target, values, env_ids, columns)


def _make_data(
    entity: Entity, indexing: EntityIndexing, model: Any, data: Any, device: str
) -> EntityData:
    """Return the data of `entity`: defaults from its config, zero targets."""
    num_envs = data.nworld
    num_joints = len(indexing.joints)

    def row(values: Any) -> torch.Tensor:
        """Return one row per environment, in separate memory."""
        one = torch.as_tensor(values, dtype=torch.float32, device=device)
        return one.expand(num_envs, *one.shape).clone()

    def zeros(width: int) -> torch.Tensor:
        return torch.zeros(num_envs, width, dtype=torch.float32, device=device)

    articulation = entity.cfg.articulation
    factor = 1.0 if articulation is None else articulation.soft_joint_pos_limit_factor
    ids = indexing.joint_ids.long()
    # Read from the simulation, because limits may differ between variants.
    limits, limited = model.jnt_range[:, ids].clone().float(), model.jnt_limited[..., ids].bool()
    limits[..., 0].masked_fill_(~limited, -torch.inf)
    limits[..., 1].masked_fill_(~limited, torch.inf)
    middle, half = limits.mean(dim=-1), 0.5 * factor * (limits[..., 1] - limits[..., 0])
    shrunk = torch.stack((middle - half, middle + half), dim=-1)
    num_tendons = len(indexing.tendons) if entity.has_tendon_actuators else 0
    targets: dict[str, Any] = {
        **{f"joint_{kind}_target": zeros(num_joints) for kind in ("pos", "vel", "effort")},
        **{f"tendon_{kind}_target": zeros(num_tendons) for kind in ("len", "vel", "effort")},
    }
    return EntityData(
        indexing=indexing,
        data=data,
        model=model,
        device=device,
        default_root_state=row(entity.initial_state.root_state),
        default_joint_pos=row(entity.initial_state.joint_pos),
        default_joint_vel=row(entity.initial_state.joint_vel),
        default_joint_pos_limits=limits,
        joint_pos_limits=limits.clone(),
        soft_joint_pos_limits=torch.where(torch.isinf(limits), limits, shrunk),
        gravity_vec_w=row((0.0, 0.0, -1.0)),
        forward_vec_b=row((1.0, 0.0, 0.0)),
        is_fixed_base=entity.is_fixed_base,
        is_articulated=entity.is_articulated,
        is_actuated=entity.is_actuated,
        **targets,
        site_effort_target=zeros(len(indexing.sites) if entity.has_site_actuators else 0),
        encoder_bias=zeros(num_joints),
    )
