"""Contract between mjlab and a physics engine.

Everything above this file sees batched torch tensors; everything below it is internal to one
engine. `sim/native/` and `sim/warp/` are the only two implementations and the only two folders
that import `mujoco.batch`, `warp` or `mujoco_warp`. `create_engine` imports them lazily, so a CPU
run never loads Warp and `import mjlab.envs` works without Warp.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Container
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import mujoco
import torch

from mjlab.utils.errors import MjlabError, UnknownAttributeError, check_one_of

if TYPE_CHECKING:
    from mjlab.sim.config import SimulationCfg

Stage = Literal["pos", "vel", "acc"]
"""Last stage of a forward pass: positions; positions and velocities; everything."""

STAGES = {
    name: int(getattr(mujoco.mjtStage, f"mjSTAGE_{name.upper()}")) for name in get_args(Stage)
}
"""MuJoCo's numbers of stages."""

# Fields that MuJoCo stores as nine numbers in a row and that cross the seam as 3 x 3 matrices.
ROTATION_MATRICES = frozenset({"xmat", "ximat", "geom_xmat", "site_xmat", "cam_xmat", "cam_mat0"})

# Inputs of the next step that a reset sets to zero.
ZERO_INPUTS = (
    *("time", "qvel", "act", "qacc_warmstart", "ctrl", "qfrc_applied", "xfrc_applied", "userdata"),
)
# All inputs of the next step: written by the user, or carried on by the step itself.
INPUTS = (*ZERO_INPUTS, "qpos", "eq_active", "mocap_pos", "mocap_quat")

# Results that MuJoCo's reset clears too.
RESULTS_ZERO_ON_RESET = frozenset({"qacc", "act_dot", "sensordata"})

# Derived fields that a forward pass computes in its second and in its last stage, beside columns of
# `sensordata`.
VELOCITY_FIELDS = frozenset(
    {"cvel", "cdof_dot", "actuator_velocity", "ten_velocity", "flexedge_velocity", "energy"}
    | {"qfrc_bias", "qfrc_passive", "qfrc_spring", "qfrc_damper", "qfrc_gravcomp", "qfrc_fluid"}
    | {"subtree_linvel", "subtree_angmom"}
)
ACCELERATION_FIELDS = frozenset(
    # Counts of contacts and constraints, and what depends on them, belong to the forces.
    {"ncon", "ne", "nf", "nl", "nefc", "nJ", "nA", "nisland", "nidof", "qfrc_adhesion"}
    | {"qacc", "qacc_smooth", "qfrc_smooth", "qfrc_constraint", "qfrc_actuator", "qfrc_inverse"}
    | {"actuator_force", "act_dot", "cacc", "cfrc_int", "cfrc_ext"}
    | {"solver", "solver_niter", "solver_nnz", "solver_fwdinv"}
)

# Which geoms may touch each other.
COLLISION_MASKS = ("geom_contype", "geom_conaffinity")

_FORCE_SENSORS = ("accelerometer", "force", "torque", "framelinacc", "frameangacc")
_SENSORS_BY_FIELD = {
    **dict.fromkeys(("cacc", "cfrc_int", "cfrc_ext"), _FORCE_SENSORS),
    **dict.fromkeys(("subtree_linvel", "subtree_angmom"), ("subtreelinvel", "subtreeangmom")),
}


def check_sensor_fed(model: mujoco.MjModel, field: str) -> None:
    """Check that MuJoCo computes a data field in `model`; some it computes for sensors only.

    Without such a sensor they hold zeros on one engine and intermediate results on the other.

    Raises:
        AttributeError: names the sensors of which one must be added, or what to read instead.
    """
    if field == "qfrc_inverse":
        # No step runs inverse dynamics, so it would read zero for ever.
        raise UnknownAttributeError(
            "MuJoCo computes MjData.qfrc_inverse in inverse dynamics only, which no step runs. The "
            "forces that drive the joints are qfrc_actuator + qfrc_applied."
        )
    sensors = _SENSORS_BY_FIELD.get(field, ())
    types = [getattr(mujoco.mjtSensor, f"mjSENS_{name.upper()}") for name in sensors]
    if sensors and not any((model.sensor_type == kind).any() for kind in types):
        raise UnknownAttributeError(
            f"MuJoCo computes MjData.{field} only if the model has a sensor that needs it. Add one "
            f"of these sensors to it: {', '.join(sensors)}."
        )


# Rays.


@dataclass(frozen=True)
class RayQuery:
    """R world-frame rays in each of N environments."""

    origins: torch.Tensor
    """(N, R, 3), in m."""
    directions: torch.Tensor
    """(N, R, 3) unit vectors."""
    geom_groups: tuple[int, ...] | None = None
    """Groups that can be hit; None for all six."""
    exclude_body_ids: torch.Tensor | None = None
    """(R,) int32 body whose own geoms are ignored, -1 for none."""
    max_distances: torch.Tensor | None = None
    """(R,), in m; what is farther away is a miss. None for no limit."""
    env_ids: torch.Tensor | None = None
    """Environments (n,) int64 whose results are needed; those of others may be misses. None: all."""


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
    """One camera of the model, and which images of it to render."""

    camera_id: int
    """Camera in the model."""
    width: int
    """Columns of the image."""
    height: int
    """Rows of the image."""
    data_types: tuple[str, ...]
    """Some of `CAMERA_DATA_TYPES`; the others are not computed."""
    geom_groups: tuple[int, ...]
    """Groups of the visible geoms, ascending."""
    use_textures: bool = True
    """Show the textures of materials."""
    use_shadows: bool = False
    """Count an obstructed light 0.3."""


@dataclass
class Images:
    """Images of a view in each of N environments; None for types that the view does not have.

    The first row of an image is at its top. The tensors are overwritten by the next rendering.
    """

    rgb: torch.Tensor | None = None
    """(N, height, width, 3) uint8."""
    depth: torch.Tensor | None = None
    """(N, height, width, 1) float32: depth along the optical axis (m), 0 without a geom."""
    segmentation: torch.Tensor | None = None
    """(N, height, width, 2) int32: id and type of the object, -1 and -1 without a geom."""

    @classmethod
    def empty(cls, view: CameraView, num_envs: int, device: str | torch.device) -> Images:
        """Allocate images that show nothing."""
        images = cls()
        for name, channels, dtype, nothing in (
            ("rgb", 3, torch.uint8, 0),
            ("depth", 1, torch.float32, 0),
            ("segmentation", 2, torch.int32, BACKGROUND),
        ):
            if name in view.data_types:
                shape = (num_envs, view.height, view.width, channels)
                setattr(images, name, torch.full(shape, nothing, dtype=dtype, device=device))
        return images


def rendered_geoms(model: mujoco.MjModel, groups: Container[int]) -> list[int]:
    """Return the geoms of some groups, ascending.

    MuJoCo counts a group beyond 0 to 5 as the nearest of these.
    """
    return [i for i, group in enumerate(model.geom_group.clip(0, 5)) if group in groups]


# Engine.


class EngineUnavailableError(MjlabError, RuntimeError):
    """Raised at construction when the chosen engine cannot run here; says what to use instead."""


@dataclass(frozen=True)
class Capabilities:
    """What an engine is and can do. Read when a task is built, never in the step loop."""

    name: str
    """`native` or `warp`."""
    description: str
    """One line for people: the library, its version, the device, the number of threads."""
    num_threads: int | None = None
    """Physics threads, or None where the engine has no such notion."""
    raycast_problem: str | None = None
    """Why `Engine.raycast` does not work with this model, and what to do; None if it works."""
    render_problem: str | None = None
    """Why `Engine.render` does not work with this model, and what to do; None if it works."""


class Engine(ABC):
    """N copies of one MuJoCo model, advanced together.

    Fields carry MuJoCo's names and shapes with a leading environment dimension N, as float32,
    int32 or bool tensors on one device; rotation matrices are (..., 3, 3). They are live: the
    engine writes results into them, and what is written into them in place is the input of the
    next call. A tensor returned by `data_field` stays valid for the life of the engine.

    `env_ids` is None for all environments, or a one-dimensional int64 tensor, which is sorted and
    unique on a CPU.
    """

    num_envs: int
    capabilities: Capabilities
    model_fields: dict[str, torch.Tensor]
    """Live (N, ...) tensors of the `MjModel` (and `MjOption`) fields that are expanded."""
    judged_fields: tuple[str, ...] = ("qpos", "qvel")
    """`MjData` fields that `bad_states` looks at."""

    @abstractmethod
    def data_field(self, name: str) -> torch.Tensor:
        """Return the live (N, ...) tensor of an `MjData` field.

        A derived field holds current values as soon as it is returned, whether or not it was
        asked for before.

        Raises:
            AttributeError: the engine has no such field; the message lists close names.
        """

    @abstractmethod
    def expand(self, fields: tuple[str, ...]) -> None:
        """Give every environment its own copy of `MjModel` fields, seeded with the shared values.

        Fields that are expanded already are left alone.

        Raises:
            ValueError: the engine cannot hold the field per environment, by name.
        """

    @abstractmethod
    def hide_geoms(self, absent: torch.Tensor) -> None:
        """Keep geoms from touching anything in some environments, for good.

        `geom_contype` and `geom_conaffinity` become fields that say so, and are not to be written.
        Rays and images leave them out because they are fully transparent, which is up to the
        caller; an explicit contact pair of such a geom still acts.

        Args:
            absent: (N, ngeom) bool.

        Raises:
            ValueError: an option in effect makes the engine unable to.
        """

    @abstractmethod
    def constants_written_by(self, level: int) -> tuple[str, ...]:
        """Return the model fields that `recompute_constants(level)` writes."""

    @abstractmethod
    def recompute_constants(self, level: int, env_ids: torch.Tensor | None) -> None:
        """Recompute constants that derive from expanded fields; qpos and qvel stay as they are.

        `level` is a `RecomputeLevel` value (1 fixed, 2 at qpos0, 3 both). An engine may do more
        than the level asks for. Expands what it writes.
        """

    @abstractmethod
    def step(self, nstep: int, record: tuple[str, ...] = ()) -> dict[str, torch.Tensor]:
        """Advance all environments by `nstep` physics steps.

        Returns:
            Values of the data fields in `record` after every step, (nstep, N, ...).
        """

    @abstractmethod
    def forward(self, env_ids: torch.Tensor | None, stage: Stage = "acc") -> None:
        """Make derived fields up to a stage current with the state, without advancing time.

        `"pos"`: positions. `"vel"`: velocities too. `"acc"`: everything. Fields and
        sensors of later stages keep their values.
        """

    def forward_after_reset(self, reset_ids: torch.Tensor) -> None:
        """Make everything current in some environments, positions and velocities in the others."""
        self.forward(None, "vel")
        self.forward(reset_ids)

    @abstractmethod
    def look_ahead(self, env_ids: torch.Tensor) -> Any:
        """Run `forward(env_ids, "vel")`, and return for `look_back` the derived fields before it.

        An engine may make the other environments current too.
        """

    @abstractmethod
    def look_back(self, env_ids: torch.Tensor, before: Any) -> None:
        """Put back the derived fields that `look_ahead(env_ids)` returned."""

    @abstractmethod
    def reset(self, env_ids: torch.Tensor | None) -> None:
        """Put environments into the model's initial state: time 0, qpos0, everything else zero.

        Derived fields and model fields keep their values until `forward`.
        """

    def bad_states(self) -> torch.Tensor:
        """Return where the last step left a state that MuJoCo calls bad, (N,) bool.

        Positions, velocities or accelerations are not finite, or beyond `mjMAXVAL` (1e10).
        """
        bad = torch.zeros(self.num_envs, dtype=torch.bool, device=self.data_field("qpos").device)
        for name in self.judged_fields:
            values = self.data_field(name)
            if values.shape[1] > 0:
                # Comparisons with NaN are false.
                bad |= ~(values.abs().amax(dim=1) <= mujoco.mjMAXVAL)
        return bad

    def bad_dof(self, env_idx: int) -> int | None:
        """Return the degree of freedom at which MuJoCo found the state bad; None if it is not known."""
        return None

    @abstractmethod
    def raycast(self, query: RayQuery) -> RayHits:
        """Cast rays at the current state.

        A ray meets the nearest surface that it may meet: planes from above, the outside of
        meshes, the top of height fields from above, and either side of other geoms. A geom that is
        fully transparent (its material's alpha counts, where it has one) is not there.
        """

    @abstractmethod
    def render(self, views: tuple[CameraView, ...]) -> list[Images]:
        """Render what cameras of the model see, at the poses that derived fields have.

        A ray through the center of each pixel meets the nearest surface of a geom of the view's
        groups that is not fully transparent: planes from above, height fields from above, and other
        geoms from outside. Its color is that of its geom or material, times the texture, times
        the light that falls on it. Beyond the model's far limit (`vis.map.zfar`), and where there
        is nothing, colours are those of the skybox, or black.

        Args:
            views: What to render. The same tuple as in an earlier call is served fastest.

        Returns:
            Images in the order of `views`. Their tensors may be overwritten by the next call.
        """

    @abstractmethod
    def copy_to_host(self, env_idx: int, mj_data: mujoco.MjData) -> None:
        """Write the full state of one environment into `mj_data`, without a forward pass."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return everything an exact resume needs, as tensors and plain values on the CPU."""

    def check_state(self, state: dict[str, Any]) -> None:  # noqa: B027 - accepts all by default.
        """Raise ValueError if `state` is of another release of the engine, or of another size."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned.

        Positions, velocities and their sensors are current afterwards, quantities of the
        acceleration stage as they were saved. `check_state` accepts `state`.
        """

    def create_graph(self) -> None:  # noqa: B027 - optional hook: the native engine captures none.
        """Capture graphs again, after memory that they use was replaced."""

    def close(self) -> None:  # noqa: B027 - optional hook: most engines hold nothing to free.
        """Free what the engine holds outside Python's reach."""


_ENGINES = {
    "native": ("mjlab.sim.native.engine", "NativeEngine"),
    "warp": ("mjlab.sim.warp.engine", "WarpEngine"),
}


def resolve_engine_name(requested: str, device: str) -> str:
    """Return `native` or `warp` for a `SimulationCfg.engine` value and a torch device.

    Raises:
        ValueError: unknown engine name.
        EngineUnavailableError: an engine that cannot serve the device.
    """
    on_cpu = device.split(":")[0] == "cpu"
    if requested == "auto":
        return "native" if on_cpu else "warp"
    check_one_of("SimulationCfg.engine", requested, ("auto", *_ENGINES))
    if requested == "native" and not on_cpu:
        raise EngineUnavailableError(
            f"The native engine runs on the CPU, but the device is {device!r}. "
            "Use --device cpu, or --engine warp."
        )
    return requested


def create_engine(
    name: str, model: mujoco.MjModel, num_envs: int, cfg: SimulationCfg, device: str
) -> Engine:
    """Build the engine called `name` (a result of `resolve_engine_name`).

    Raises:
        EngineUnavailableError: its package is missing, or it cannot run on this machine.
    """
    module_name, class_name = _ENGINES[name]
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise EngineUnavailableError(
            f"The {name} engine cannot be loaded: {error}. Install the missing package, or use "
            f"--engine {'warp' if name == 'native' else 'native'}."
        ) from error
    return getattr(module, class_name)(model, num_envs, cfg, device)
