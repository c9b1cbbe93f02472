"""Interface between mjlab and a physics engine.

Code above this file sees batched torch tensors; code below it is internal to one engine.
`sim/native/` and `sim/warp/` are the only two implementations and the only two folders that import
`mujoco.batch`, `warp` or `mujoco_warp`. `create_engine` imports them lazily, so a CPU run never
loads Warp and `import mjlab.envs` works without Warp.
"""

from __future__ import annotations

import importlib
import math
from abc import ABC, abstractmethod
from collections.abc import Container
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import mujoco
import torch

from mjlab.utils.errors import MjlabError, check_one_of
from mjlab.utils.memory import check_memory

if TYPE_CHECKING:
    from mjlab.sim.config import SimulationCfg

Stage = Literal["pos", "vel", "acc"]
"""Last stage of a forward pass: positions, velocities, accelerations and forces."""

STAGES = {
    name: int(getattr(mujoco.mjtStage, f"mjSTAGE_{name.upper()}")) for name in get_args(Stage)
}
"""Stage numbers of MuJoCo (`mjtStage`)."""

# Rotation matrices. MuJoCo stores rows of nine numbers; engines return 3 x 3 matrices.
ROTATION_MATRICES = frozenset({"xmat", "ximat", "geom_xmat", "site_xmat", "cam_xmat", "cam_mat0"})

# Inputs of the next step that a reset sets to zero.
ZERO_INPUTS = (
    *("time", "qvel", "act", "qacc_warmstart", "ctrl", "qfrc_applied", "xfrc_applied", "userdata"),
)
# All inputs of the next step: written by the user, or advanced by the step itself.
INPUTS = (*ZERO_INPUTS, "qpos", "eq_active", "mocap_pos", "mocap_quat")

# Results that MuJoCo's reset also clears.
RESULTS_ZERO_ON_RESET = frozenset({"qacc", "act_dot", "sensordata"})

# Derived fields of the velocity and acceleration stages, in addition to columns of `sensordata`.
VELOCITY_FIELDS = frozenset(
    {"cvel", "cdof_dot", "actuator_velocity", "ten_velocity", "flexedge_velocity", "energy"}
    | {"qfrc_bias", "qfrc_passive", "qfrc_spring", "qfrc_damper", "qfrc_gravcomp", "qfrc_fluid"}
    | {"subtree_linvel", "subtree_angmom"}
)
ACCELERATION_FIELDS = frozenset(
    # Counts of contacts and constraints, and fields that depend on them, belong to the forces.
    {"ncon", "ne", "nf", "nl", "nefc", "nJ", "nA", "nisland", "nidof", "qfrc_adhesion"}
    | {"qacc", "qacc_smooth", "qfrc_smooth", "qfrc_constraint", "qfrc_actuator", "qfrc_inverse"}
    | {"actuator_force", "act_dot", "cacc", "cfrc_int", "cfrc_ext"}
    | {"solver", "solver_niter", "solver_nnz", "solver_fwdinv"}
)

# Fields that `mj_setConst` writes: sums over the tree, and values that depend on qpos0.
FIXED_CONSTANTS = ("body_subtreemass",)
# Those of bodies, joints, tendons and actuators that events declare beside their own fields.
INERTIAL_CONSTANTS = (
    *("dof_invweight0", "body_invweight0", "tendon_length0", "tendon_invweight0", "actuator_acc0"),
)
CONSTANTS_AT_QPOS0 = (
    *INERTIAL_CONSTANTS,
    *("actuator_biasprm", "eq_data"),
    *("cam_pos0", "cam_poscom0", "cam_mat0", "light_pos0", "light_poscom0", "light_dir0"),
)

# Collision filters of geoms.
COLLISION_MASKS = ("geom_contype", "geom_conaffinity")

_FORCE_SENSORS = ("accelerometer", "force", "torque", "framelinacc", "frameangacc")
_SENSORS_BY_FIELD = {
    **dict.fromkeys(("cacc", "cfrc_int", "cfrc_ext"), _FORCE_SENSORS),
    **dict.fromkeys(("subtree_linvel", "subtree_angmom"), ("subtreelinvel", "subtreeangmom")),
}


def why_not_computed(model: mujoco.MjModel, field: str) -> str | None:
    """Return the reason if steps do not compute a data field in `model`, None if steps do.

    Such fields hold zeros on one engine and intermediate results on the other.
    """
    if field == "qfrc_inverse":
        return (
            "is computed by inverse dynamics only, and steps do not run it; for the forces that "
            "drive the joints use qfrc_actuator + qfrc_applied"
        )
    if field == "energy" and not model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_ENERGY:
        return "is computed only with MujocoCfg.enableflags=('energy',)"
    sensors = _SENSORS_BY_FIELD.get(field, ())
    types = [getattr(mujoco.mjtSensor, f"mjSENS_{name.upper()}") for name in sensors]
    if sensors and not any((model.sensor_type == kind).any() for kind in types):
        return (
            "is computed only if the model has a sensor that needs it; add one of the sensors "
            f"{', '.join(sensors)}"
        )
    return None


def is_bad(values: torch.Tensor) -> torch.Tensor:
    """Return rows with a value that is not finite or beyond `mjMAXVAL`, (N,) bool."""
    if values.shape[1] == 0:
        return torch.zeros(len(values), dtype=torch.bool, device=values.device)
    # Comparisons with NaN are false.
    return ~(values.abs().amax(dim=1) <= mujoco.mjMAXVAL)


# Rays.


@dataclass(frozen=True)
class RayQuery:
    """Ray query: R world-frame rays in each of N environments."""

    origins: torch.Tensor
    """Start points (m), (N, R, 3)."""
    directions: torch.Tensor
    """Unit vectors, (N, R, 3)."""
    geom_groups: tuple[int, ...] | None = None
    """Geom groups that can be hit. None: all six."""
    exclude_body_ids: torch.Tensor | None = None
    """Body whose own geoms are ignored, per ray, (R,) int32. -1: none."""
    max_distances: torch.Tensor | None = None
    """Maximum distance (m), (R,). Farther hits are misses. None: no limit."""
    env_ids: torch.Tensor | None = None
    """Environments whose results are used, (n,) int64. Others may get misses. None: all."""


RayHits = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
"""Distances (N, R), -1 on a miss; normals (N, R, 3), zero on a miss; geom ids (N, R) int32, -1 on a
miss."""

# Rendering.

CameraDataType = Literal["rgb", "depth", "segmentation"]
"""Type of an image."""

CAMERA_DATA_TYPES: tuple[str, ...] = get_args(CameraDataType)
NUM_GEOM_GROUPS = 6

LENS_FIELDS = frozenset({"cam_fovy", "cam_intrinsic"})
"""Model fields that determine the rays of a camera's pixels."""

# Segmentation of pixels without a geom.
BACKGROUND = -1


@dataclass(frozen=True)
class CameraView:
    """Camera of the model and the images to render from it."""

    camera_id: int
    """Camera id in the model."""
    width: int
    """Image width (pixels)."""
    height: int
    """Image height (pixels)."""
    data_types: tuple[str, ...]
    """Image types to render, from `CAMERA_DATA_TYPES`."""
    geom_groups: tuple[int, ...]
    """Groups of the visible geoms, ascending."""
    use_textures: bool = True
    """Render the textures of materials."""
    use_shadows: bool = False
    """Render shadows: scale obstructed lights by 0.3."""


@dataclass
class Images:
    """Images of a view in N environments. Types not in `data_types` are None.

    The first row of an image is at its top. The tensors are overwritten by the next rendering.
    """

    rgb: torch.Tensor | None = None
    """Color, (N, height, width, 3) uint8."""
    depth: torch.Tensor | None = None
    """Depth along the optical axis (m), (N, height, width, 1) float32. 0 without a geom."""
    segmentation: torch.Tensor | None = None
    """Id and type of the object, (N, height, width, 2) int32. -1 and -1 without a geom."""

    @classmethod
    def empty(cls, view: CameraView, num_envs: int, device: str | torch.device) -> Images:
        """Allocate empty images."""
        images = cls()
        for name, channels, dtype, nothing in (
            ("rgb", 3, torch.uint8, 0),
            ("depth", 1, torch.float32, 0),
            ("segmentation", 2, torch.int32, BACKGROUND),
        ):
            if name in view.data_types:
                shape = (num_envs, view.height, view.width, channels)
                check_memory(
                    f"{name} numbers of all cameras", math.prod(shape), dtype.itemsize, str(device),
                    "smaller images, or fewer environments",
                )  # fmt: skip
                setattr(images, name, torch.full(shape, nothing, dtype=dtype, device=device))
        return images


def rendered_geoms(model: mujoco.MjModel, groups: Container[int]) -> list[int]:
    """Return the ids of geoms in `groups`, ascending.

    As in MuJoCo, groups are clipped to 0..5.
    """
    return [i for i, group in enumerate(model.geom_group.clip(0, 5)) if group in groups]


# Engine.


class EngineUnavailableError(MjlabError, RuntimeError):
    """Engine that cannot run here. Raised at construction; the message names an alternative."""


@dataclass(frozen=True)
class Capabilities:
    """Engine capabilities, queried at build time."""

    name: str
    """`native` or `warp`."""
    description: str
    """Human-readable line: library, version, device, number of threads."""
    num_threads: int | None = None
    """Number of physics threads; None for engines without threads."""
    raycast_problem: str | None = None
    """Error message if `Engine.raycast` does not support this model; None if it does."""
    render_problem: str | None = None
    """Error message if `Engine.render` does not support this model; None if it does."""


class Engine(ABC):
    """N copies of one MuJoCo model, advanced together.

    Fields have MuJoCo's names and shapes with a leading environment dimension N, as float32, int32
    or bool tensors on one device. Rotation matrices are (..., 3, 3). Tensors are live: the engine
    writes results into them, and values written in place are inputs of the next call. A tensor
    returned by `data_field` stays valid for the lifetime of the engine.

    `env_ids` is None (all environments) or a one-dimensional int64 tensor; sorted and unique on a
    CPU.
    """

    num_envs: int
    capabilities: Capabilities
    model_fields: dict[str, torch.Tensor]
    """Live tensors of the expanded `MjModel` and `MjOption` fields, (N, ...)."""
    bytes_each: int = 0
    """Memory reserved per environment (bytes). Observations and images come on top: cartpole, Go1, G1
    and YAM take 1.2 to 1.6 times as much, and 5.5 times with images of 32 x 32 pixels."""
    _fits = True

    def reserve(self, bytes_each: int, device: str = "cpu") -> None:
        """Add to the memory per environment, before allocating it; see `check_memory`.

        Raises:
            ValueError: all environments together exceed the memory.
        """
        self.bytes_each += bytes_each
        self._fits &= check_memory(
            "num_envs", self.num_envs, self.bytes_each, device, "fewer environments",
            usual=1.5, warns=self._fits,
        )  # fmt: skip

    @abstractmethod
    def data_field(self, name: str) -> torch.Tensor:
        """Return the live tensor of an `MjData` field, (N, ...).

        A derived field has current values when it is returned, also on its first access.

        Raises:
            AttributeError: unknown field; the message lists close names.
        """

    @abstractmethod
    def expand(self, fields: tuple[str, ...]) -> None:
        """Expand `MjModel` fields to per-environment copies of the shared values.

        Fields that are already expanded keep their values.

        Raises:
            ValueError: unknown field, or one that the engine cannot expand.
        """

    @abstractmethod
    def structure_field(self, name: str) -> torch.Tensor | None:
        """Return the live tensor of an `MjModel` field without environment dimension.

        Values that MuJoCo compiled from it, such as collision pairs, are unchanged. None: the engine
        compiles the field, so that writing it has no effect.

        Raises:
            WrongStateError: engine copies the field when it is built.
        """

    @abstractmethod
    def hide_geoms(self, absent: torch.Tensor) -> None:
        """Disable contacts of geoms per environment, permanently.

        `geom_contype` and `geom_conaffinity` become per-environment fields, 0 for these geoms. Do
        not write them. Callers must make the geoms fully transparent, so that rays and images
        ignore them. Explicit contact pairs of these geoms stay active.

        Args:
            absent: Geoms to hide, (N, ngeom) bool.

        Raises:
            ValueError: not supported with the current options.
        """

    @abstractmethod
    def constants_written_by(self, level: int) -> tuple[str, ...]:
        """Return the names of model fields that `recompute_constants(level)` writes."""

    @abstractmethod
    def recompute_constants(self, level: int, env_ids: torch.Tensor | None) -> None:
        """Recompute constants derived from expanded fields; `qpos` and `qvel` are unchanged.

        `level` is a `RecomputeLevel` value (1 fixed, 2 at qpos0, 3 both). An engine may recompute
        more than `level` requires. Fields it writes are expanded.
        """

    @abstractmethod
    def step(self, nstep: int, record: tuple[str, ...] = ()) -> dict[str, torch.Tensor]:
        """Advance all environments by `nstep` physics steps.

        Returns:
            Values of the data fields in `record` after every step, (nstep, N, ...).
        """

    @abstractmethod
    def forward(self, env_ids: torch.Tensor | None, stage: Stage = "acc") -> None:
        """Compute derived fields up to a stage, without advancing time.

        `"pos"`: positions. `"vel"`: also velocities. `"acc"`: everything. Fields and sensors of
        later stages keep their values.
        """

    @abstractmethod
    def look_ahead(self, env_ids: torch.Tensor) -> Any:
        """Run `forward(env_ids, "vel")`; return the previous derived fields, for `look_back`.

        An engine may update the other environments too.
        """

    @abstractmethod
    def look_back(self, env_ids: torch.Tensor, before: Any) -> None:
        """Restore the derived fields returned by `look_ahead(env_ids)`."""

    @abstractmethod
    def reset(self, env_ids: torch.Tensor | None) -> None:
        """Reset environments to the initial state: time 0, `qpos0`, everything else zero.

        Derived fields keep their values until `forward`; model fields are unchanged.
        """

    @abstractmethod
    def bad_substeps(self) -> torch.Tensor:
        """Return environments with accelerations, or a state within the step, in a bad state, (N,) bool.

        See `Simulation.bad_states`.
        """

    def bad_dof(self, env_idx: int) -> int | None:
        """Return the degree of freedom at which MuJoCo found a bad state; None if unknown."""
        return None

    @abstractmethod
    def raycast(self, query: RayQuery) -> RayHits:
        """Cast rays at the current state.

        A ray hits the nearest of: planes from above, the outside of meshes, the top of height
        fields from above, and either side of other geoms. Fully transparent geoms are ignored; the
        alpha of a geom with a material is the material's.
        """

    @abstractmethod
    def render(self, views: tuple[CameraView, ...]) -> list[Images]:
        """Render cameras of the model at the poses in derived fields.

        A ray through the center of each pixel hits the nearest surface of a geom of the view's
        groups that is not fully transparent: planes and height fields from above, other geoms from
        outside. The pixel's color is that of the geom or material, times texture, times light.
        Without a hit, or beyond the far plane (`vis.map.zfar`), it is that of the skybox, or black.

        Args:
            views: Views to render. Repeating the tuple of an earlier call is fastest.

        Returns:
            Images in the order of `views`. Their tensors may be overwritten by the next call.
        """

    @abstractmethod
    def copy_to_host(self, env_idx: int, mj_data: mujoco.MjData) -> None:
        """Copy the full state of one environment to `mj_data`, without a forward pass."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return the state for exact resume, as tensors and plain values on the CPU."""

    def check_state(self, state: dict[str, Any]) -> None:  # noqa: B027 - accepts all by default.
        """Raise `ValueError` if the engine release or size of `state` does not match."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state returned by `state_dict` and accepted by `check_state`.

        Afterwards positions, velocities and their sensors are current, and fields of the
        acceleration stage have their saved values.
        """

    def create_graph(self) -> None:  # noqa: B027 - optional hook: the native engine captures none.
        """Recapture graphs after memory that they use was replaced."""

    def close(self) -> None:  # noqa: B027 - optional hook: most engines hold nothing to free.
        """Release resources that Python does not manage."""


_ENGINES = {
    "native": ("mjlab.sim.native.engine", "NativeEngine"),
    "warp": ("mjlab.sim.warp.engine", "WarpEngine"),
}


def resolve_engine_name(requested: str, device: str) -> str:
    """Return `native` or `warp` for a `SimulationCfg.engine` value and a torch device.

    Raises:
        ValueError: unknown engine name.
        EngineUnavailableError: engine does not support the device.
    """
    on_cpu = device.split(":")[0] == "cpu"
    if requested == "auto":
        return "native" if on_cpu else "warp"
    check_one_of("SimulationCfg.engine", requested, ("auto", *_ENGINES))
    if requested == "native" and not on_cpu:
        raise EngineUnavailableError(
            f"SimulationCfg.engine 'native': expected device 'cpu', got {device!r}; use --device cpu "
            "or --engine warp."
        )
    return requested


def create_engine(
    name: str, model: mujoco.MjModel, num_envs: int, cfg: SimulationCfg, device: str
) -> Engine:
    """Build the engine `name`, as returned by `resolve_engine_name`.

    Raises:
        EngineUnavailableError: package missing, or the engine cannot run on this machine.
    """
    module_name, class_name = _ENGINES[name]
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise EngineUnavailableError(
            f"Failed to import the {name} engine: {error}; install the missing package, or use "
            f"--engine {'warp' if name == 'native' else 'native'}."
        ) from error
    return getattr(module, class_name)(model, num_envs, cfg, device)


def mirror_on_warp(
    engine: Engine, model: mujoco.MjModel, host: mujoco.MjData, cfg: SimulationCfg
) -> Any:
    """Return MuJoCo Warp structs on the tensors of a CPU engine, see `WarpMirror`."""
    return importlib.import_module("mjlab.sim.warp.mirror").WarpMirror(engine, model, host, cfg)
