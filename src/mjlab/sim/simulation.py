"""Facade over the physics engines: one class for both."""

from __future__ import annotations

import contextlib
import copy
import logging
import math
import warnings
from collections.abc import Callable, Generator
from functools import cached_property, partial
from typing import Any

import mujoco
import numpy as np
import torch

from mjlab.sim.config import SimulationCfg
from mjlab.sim.divergence import collect_mujoco_warnings
from mjlab.sim.engine import (
    CameraView,
    Capabilities,
    EngineUnavailableError,
    Images,
    RayHits,
    RayQuery,
    Stage,
    create_engine,
    is_bad,
    mirror_on_warp,
    resolve_engine_name,
    why_not_computed,
)
from mjlab.sim.randomization import (
    BASES_OF_CONSTANTS,
    RecomputeLevel,
    VariantInfo,
    VariantValues,
    is_structure,
)
from mjlab.sim.sim_data import FieldView
from mjlab.utils.errors import UnknownAttributeError, check_positive
from mjlab.utils.indexing import EnvIds, as_ids
from mjlab.utils.memory import check_memory
from mjlab.utils.mujoco import moving_dofs
from mjlab.utils.nan_guard import NanGuard
from mjlab.utils.spec import compile_spec
from mjlab.utils.string import counted

logger = logging.getLogger(__name__)

# Bytes of an environment of any model: state of one joint, origin, episode length, reward.
_LEAST_BYTES = 300
# Row shapes of fields that MuJoCo stores flat; the same as in MuJoCo Warp.
_ROW_SHAPES = {"cam_mat0": (3, 3), "geom_aabb": (2, 3)}


class Simulation:
    """N copies of one MuJoCo model, advanced together by the configured engine.

    Fields are `sim.data.<field>` and `sim.model.<field>`: torch tensors (float32, int32 or bool)
    with MuJoCo's names and a leading environment dimension, live and written in place. Rotation
    matrices are (..., 3, 3), and `geom_aabb` is (N, ngeom, 2, 3): center and half sizes. Sizes
    (`model.nv`) are ints. Structure (addresses, ids, types, flags, assets: `model.geom_bodyid`) has
    no environment dimension unless it is expanded. Options are `sim.model.opt.<field>`:
    floats are (N, ...) tensors, integers are ints.

    After `step`, `qpos`, `qvel`, `act` and `time` are current, and every derived field (`xpos`,
    `cvel`, `sensordata`, ...) belongs to the state before the last physics substep. After
    `forward` all are current up to its stage; with `stage="vel"`, forces, accelerations and their
    sensors remain those of the last substep.
    """

    def __init__(
        self,
        num_envs: int,
        cfg: SimulationCfg,
        model: mujoco.MjModel | None = None,
        device: str = "cuda:0",
        *,
        spec: mujoco.MjSpec | None = None,
        variant_info: list[tuple[str, VariantInfo]] | None = None,
    ) -> None:
        """Compile `spec`, or use the compiled `model`, and allocate `num_envs` copies.

        `variant_info` has the name and `variant_metadata` of each entity with per-environment
        variants. The model must be compiled from the spec that contains the variants.

        Raises:
            ValueError: `num_envs` below 1 or too large for the memory; neither `model` nor `spec`;
                unknown options; XML that does not compile (with MuJoCo's message); variants that
                differ in fields that the engine cannot expand.
            EngineUnavailableError: engine cannot run on `device`.
        """
        check_positive("num_envs", num_envs)
        if model is None and spec is None:
            raise ValueError("Simulation: expected one of `model` and `spec`, got neither.")
        if model is not None and spec is not None:
            warnings.warn(
                "Simulation: expected one of `model` and `spec`, got both; `spec` is used.",
                UserWarning,
                stacklevel=2,
            )
        engine_name = resolve_engine_name(cfg.engine, device)
        collect_mujoco_warnings()
        self.num_envs = num_envs
        self.cfg = cfg
        self.device = device
        self.mj_model: mujoco.MjModel = compile_spec(spec) if spec is not None else model
        """Compiled model on the host, without randomized values."""
        cfg.mujoco.apply(self.mj_model)
        self.mj_data = mujoco.MjData(self.mj_model)
        """Host data of the compiled model, forwarded once at `qpos0`."""
        mujoco.mj_forward(self.mj_model, self.mj_data)
        # Viewers write the values of an environment into the host model, so the defaults for
        # randomization are read from a copy.
        self._default_model = copy.copy(self.mj_model)
        self._default_fields: dict[str, torch.Tensor] = {}
        # Fields without environment dimension that were written.
        self._structure: dict[str, torch.Tensor] = {}
        self._variants: VariantValues | None = None
        self._engine: Any = create_engine(engine_name, self.mj_model, num_envs, cfg, device)
        self.data = FieldView(self._read_data_field, num_envs, "data")
        """Live `MjData` fields, (N, ...)."""
        self.model = FieldView(self._read_model_field, num_envs, "model")
        """Live `MjModel` fields. Fields that are not expanded are shared until their first write."""
        self._options = FieldView(self._read_option, num_envs, "model.opt")
        # Root of each body, (nbody,), and mask of degrees of freedom that move it, (nbody, nv).
        self._body_roots = torch.as_tensor(self.mj_model.body_rootid, device=device).long()
        self._moving_dofs = torch.as_tensor(moving_dofs(self.mj_model), device=device).float()
        # Row and column of each entry of `data.M`, which are those of the lower triangle.
        rows = np.repeat(np.arange(self.mj_model.nv), self.mj_model.M_rownnz)
        entries = np.stack((rows, self.mj_model.M_colind))
        self._mass_entries = torch.as_tensor(entries, device=device).long()
        if variant_info:
            self._apply_variants(variant_info)
        self._forward_callbacks: list[Callable[[Stage], None]] = []
        self._sensor_context: Any = None
        self.nan_guard = NanGuard(
            cfg.nan_guard,
            num_envs,
            self.mj_model,
            model_fields=lambda: {name: getattr(self.model, name) for name in self.expanded_fields},
        )
        logger.debug(
            "Physics: %s, %s.", self.capabilities.description, counted(num_envs, "environment")
        )

    @staticmethod
    def check(num_envs: int, cfg: SimulationCfg, device: str) -> None:
        """Check engine, device and memory before a model exists. Raises as the constructor does."""
        resolve_engine_name(cfg.engine, device)
        cure = "fewer environments"
        check_memory("num_envs", num_envs, _LEAST_BYTES, device, cure, warns=False)

    # Properties.

    @property
    def capabilities(self) -> Capabilities:
        """Capabilities of the engine."""
        return self._engine.capabilities

    @property
    def engine_name(self) -> str:
        """`native` or `warp`."""
        return self.capabilities.name

    # Warp engine internals.

    @property
    def wp_model(self) -> Any:
        """MuJoCo Warp model. On the native engine a mirror: expanded fields share memory."""
        return self._warp.wp_model

    @property
    def wp_data(self) -> Any:
        """MuJoCo Warp data. On the native engine a mirror that shares the memory of `sim.data`."""
        return self._warp.wp_data

    @property
    def wp_device(self) -> Any:
        """Warp device."""
        return self._warp.wp_device

    @cached_property
    def _warp(self) -> Any:
        if self.engine_name == "warp":
            return self._engine
        return mirror_on_warp(self._engine, self.mj_model, self.mj_data, self.cfg)

    def render_context(self, views: tuple[CameraView, ...], view: CameraView) -> Any:
        """Return MuJoCo Warp's render context of `view`, one of `views` rendered together.

        Raises `AttributeError` on other engines, `RuntimeError` before the first rendering.
        """
        if self.engine_name != "warp":
            raise UnknownAttributeError(
                f"Simulation.render_context: expected the warp engine, got {self.engine_name}; use the "
                "images of camera sensors on both engines."
            )
        return self._engine.renderer.context_of(views, view)

    # Model fields.

    @property
    def expanded_fields(self) -> set[str]:
        """Names of per-environment model fields."""
        return set(self._engine.model_fields)

    @property
    def per_world_default_fields(self) -> set[str]:
        """Fields with compile-time values that differ between environments, due to variants."""
        return set() if self._variants is None else set(self._variants.fields)

    @property
    def world_to_variant(self) -> dict[str, torch.Tensor]:
        """Variant index of each environment by entity, (N,) int64. Empty without variants."""
        variants = {} if self._variants is None else self._variants.world_to_variant
        return {
            name: torch.as_tensor(ids, dtype=torch.int64, device=self.device)
            for name, ids in variants.items()
        }

    @cached_property
    def absent_geoms(self) -> torch.Tensor | None:
        """Geoms absent from each environment's variants, (N, ngeom) bool; None if all are present.

        Absent geoms do not collide and are invisible. Do not write their fields.
        """
        if self._variants is None or not self._variants.absent_geoms.any():
            return None
        return torch.as_tensor(self._variants.absent_geoms, device=self.device)

    @property
    def default_model_fields(self) -> dict[str, torch.Tensor]:
        """Compile-time values fetched so far by `get_default_field`."""
        return dict(self._default_fields)

    def get_default_field(self, field: str) -> torch.Tensor:
        """Return the compile-time value of a model field, without environment dimension.

        Fields in `per_world_default_fields` have it: the compile-time values of each environment's
        variants.

        Baseline for randomization by scaling or adding, so that values do not drift. Doubles are
        returned as float32. Raises `ValueError` for an unknown field.
        """
        field = field.removeprefix("opt.")
        if field not in self._default_fields:
            value = self._host_value(field)
            if self._variants is not None and field in self._variants.fields:
                value = self._variants.get(field)
            tensor = _reshape_rows(field, torch.from_numpy(np.array(value)))
            tensor = tensor.float() if tensor.is_floating_point() else tensor
            self._default_fields[field] = tensor.to(self.device)
        return self._default_fields[field]

    def _host_value(self, field: str) -> Any:
        model = self._default_model
        value = getattr(model, field, getattr(model.opt, field, None))
        if field.startswith("_") or not isinstance(value, np.ndarray | int | float | bytes):
            raise ValueError(
                f"Unknown MjModel field {field!r}; use MuJoCo's names, such as 'body_mass' or "
                "'geom_friction'. Structs are in sim.mj_model."
            )
        return value

    def _read_data_field(self, name: str) -> Any:
        value = self._engine.data_field(name)
        if reason := why_not_computed(self.mj_model, name):
            logger.warning("sim.data.%s %s.", name, reason)
        return value

    def _read_model_field(self, name: str) -> Any:
        if name == "opt":
            return self._options
        if name in self._engine.model_fields:
            return _reshape_rows(name, self._engine.model_fields[name])
        try:
            value = self._host_value(name)
        except ValueError as error:
            raise UnknownAttributeError(str(error)) from error
        if isinstance(value, int | bytes):
            return value
        default = self.get_default_field(name)
        if is_structure(name, np.asarray(value)):
            return SharedField.make(default, None, partial(self._live_structure, name))
        return SharedField.make(default, self.num_envs, partial(self._live_field, name))

    def _live_field(self, name: str, writes: bool) -> torch.Tensor | None:
        """Return an expanded field, None if it is not expanded; expand it to write it."""
        if name not in self._engine.model_fields:
            if not writes:
                return None
            if self.num_envs > 1:
                recompute = (
                    ""
                    if name not in BASES_OF_CONSTANTS
                    else (
                        " Constants derived from it keep their values until "
                        "sim.recompute_constants(RecomputeLevel.set_const)."
                    )
                )
                logger.warning(
                    "Model field %r: expected one row per environment for writing, got one shared "
                    "row, expanded now; use sim.expand_model_fields((%r,)) before, or declare the "
                    "field with @requires_model_fields(%r).%s",
                    name, name, name, recompute,
                )  # fmt: skip
            self.expand_model_fields((name,))
        return getattr(self.model, name)

    def _live_structure(self, name: str, writes: bool) -> torch.Tensor | None:
        """Return the written value of a field without environment dimension; None before that."""
        if writes and name not in self._structure:
            value = self._engine.structure_field(name)
            logger.warning(
                "Model field %r is part of the model's structure. Writing it %s; change it in the "
                "spec or model that the Simulation is built from.",
                name,
                "has no effect on the physics" if value is None
                else "changes all environments, but not what was compiled from it",
            )  # fmt: skip
            self._structure[name] = self.get_default_field(name).clone() if value is None else value
        return self._structure.get(name)

    def _read_option(self, name: str) -> Any:
        if not hasattr(self._default_model.opt, name):
            raise UnknownAttributeError(f"Unknown MjOption field {name!r}.")
        return self._read_model_field(name)

    def _apply_variants(self, info: list[tuple[str, VariantInfo]]) -> None:
        """Set the model fields of each environment to those of its variants."""
        derived = self._engine.constants_written_by(3)
        variants = VariantValues(self._default_model, self.num_envs, info, derived)
        self._variants = variants
        for name in variants.fields:
            if problem := self._expand(name):
                names = ", ".join(repr(entity) for entity, _ in info)
                warnings.warn(
                    f"Variants of entity {names} differ in model field {name!r}, and all "
                    f"environments have the value of the first: {problem}",
                    UserWarning,
                    stacklevel=3,
                )
                variants.drop(name)
                del self._default_fields[name]
        # Updates the mean inertia too: it is not a field, and scales the solver tolerance.
        self.recompute_constants(3)
        for name in dict.fromkeys((*variants.fields, *derived)):
            if name in self._engine.model_fields:
                getattr(self.model, name).copy_(self.get_default_field(name))
        if self.absent_geoms is not None:
            self._engine.hide_geoms(self.absent_geoms)
        self._engine.forward(None)

    def expand_model_fields(self, fields: tuple[str, ...] | list[str]) -> None:
        """Expand model fields to per-environment copies of the shared values.

        Options are named `gravity` or `opt.gravity`. Structure that the engine cannot expand stays
        shared, with a warning.

        Expand before code outside torch stores references to `sim.model.<field>`: expansion
        replaces the memory. The first write to a field expands it too, with a warning.

        Raises:
            ValueError: unknown field, or one that the engine cannot expand.
        """
        for name in (name.removeprefix("opt.") for name in fields):
            if problem := self._expand(name):
                warnings.warn(f"{problem} It stays shared.", UserWarning, stacklevel=2)

    def _expand(self, name: str) -> ValueError | None:
        """Expand a field. Structure that cannot be expanded stays shared: return the reason."""
        if name in self._engine.model_fields:
            return None
        default = self.get_default_field(name)
        try:
            self._engine.expand((name,))
        except ValueError as error:
            if not is_structure(name, default.numpy(force=True)):
                raise
            return error
        self.model.forget((name,))
        self._options.forget((name,))
        return None

    def expand_constants(self, level: RecomputeLevel | int) -> None:
        """Expand the model fields that `recompute_constants(level)` writes."""
        self.expand_model_fields(self._engine.constants_written_by(int(level)))

    def recompute_constants(self, level: RecomputeLevel | int, env_ids: EnvIds = None) -> None:
        """Recompute constants derived from changed model fields, as `mj_setConst` does.

        `qpos` and `qvel` are unchanged; derived fields are those of the reference pose until the
        next `forward`. Fields that the recomputation writes are expanded.
        """
        if int(level) == 0:
            return
        self.expand_constants(level)
        self._engine.recompute_constants(int(level), self.resolve_ids(env_ids))

    # Physics.

    def step(self, nstep: int = 1, record: tuple[str, ...] = ()) -> dict[str, torch.Tensor]:
        """Advance all environments by `nstep` substeps in one dispatch.

        Returns:
            Values of the data fields in `record` after every substep, (nstep, N, ...).
        """
        if not self.nan_guard.enabled:
            return self._engine.step(nstep, record)
        recorded = []
        for _ in range(nstep):
            with self.nan_guard.watch(self.data):
                recorded.append(self._engine.step(1, record))
        return {name: torch.cat([step[name] for step in recorded]) for name in record}

    def forward(self, env_ids: EnvIds = None, stage: Stage = "acc") -> None:
        """Compute derived fields up to a stage, without advancing time.

        `"pos"`: positions. `"vel"`: also velocities. `"acc"`: everything. Fields and sensors of
        later stages keep their values.
        """
        self._engine.forward(self.resolve_ids(env_ids), stage)
        self._notify_forward(stage)

    @contextlib.contextmanager
    def looking_ahead(self, env_ids: torch.Tensor) -> Generator[None]:
        """Compute positions and velocities of `env_ids` for the duration of the `with` block.

        On exit, derived fields and the results of camera and ray sensors are restored. Within the
        block, fields of other environments may or may not be current.

        Args:
            env_ids: Environments, (n,) int64.
        """
        env_ids = env_ids.to(self.device, torch.int64)
        with contextlib.ExitStack() as undo:
            if self._sensor_context is not None:
                undo.enter_context(self._sensor_context.results_kept())
            before = self._engine.look_ahead(env_ids)
            undo.callback(self._notify_forward, "acc")
            undo.callback(self._engine.look_back, env_ids, before)
            self._notify_forward("vel")
            yield

    def bad_states(self) -> torch.Tensor:
        """Return environments in a bad state after the last step, (N,) bool.

        As in MuJoCo: positions, velocities or accelerations not finite or beyond `mjMAXVAL` (1e10).
        """
        return self._engine.bad_substeps() | is_bad(self.data.qpos) | is_bad(self.data.qvel)

    def bad_dof(self, env_idx: int) -> int | None:
        """Return the degree of freedom at which MuJoCo found a bad state; None if unknown."""
        return self._engine.bad_dof(env_idx)

    def reset(self, env_ids: EnvIds = None) -> None:
        """Reset environments to the initial state: time 0, `qpos0`, everything else zero.

        Derived fields keep their values until `forward`; model fields are unchanged.
        """
        self._engine.reset(self.resolve_ids(env_ids))

    def add_forward_callback(self, callback: Callable[[Stage], None]) -> None:
        """Register `callback(stage)`, called after each `forward` computes fields up to `stage`."""
        self._forward_callbacks.append(callback)

    def _notify_forward(self, stage: Stage) -> None:
        for callback in self._forward_callbacks:
            callback(stage)

    def sense(self, env_ids: torch.Tensor | None = None) -> None:
        """Evaluate camera and ray sensors, if any, at the current poses.

        Args:
            env_ids: Environments whose results are used, (n,) int64; others may get misses. None:
                all.
        """
        if self._sensor_context is not None:
            raycast = self.raycast if env_ids is None else partial(self.raycast, env_ids=env_ids)
            self._sensor_context.sense(raycast, self.render)

    def set_sensor_context(self, ctx: Any) -> None:
        """Set the context. Its `sense(raycast, render)` evaluates camera and ray sensors.

        Raises:
            EngineUnavailableError: the context has ray sensors or cameras, and the engine does not
                support them for this model.
        """
        problem = ctx.has_raycasts and self.capabilities.raycast_problem
        problem = problem or (ctx.has_cameras and self.capabilities.render_problem)
        if problem:
            raise EngineUnavailableError(problem)
        self._sensor_context = ctx
        ctx.set_render_context_source(self.render_context)

    def create_graph(self) -> None:
        """Recapture graphs of `step` and `forward` (Warp on CUDA only).

        Environments call this once, at the end of construction. State, results and overflow
        flags keep their values.
        """
        self._engine.create_graph()

    # Queries.

    def raycast(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        geom_groups: tuple[int, ...] | None = None,
        exclude_body_ids: torch.Tensor | None = None,
        max_distances: torch.Tensor | None = None,
        env_ids: torch.Tensor | None = None,
    ) -> RayHits:
        """Cast rays from world origins along unit directions, both (N, R, 3).

        Returns distances (N, R), -1 on a miss; normals (N, R, 3), 0 on a miss; geom ids (N, R), -1
        on a miss. Only geoms of `geom_groups` (None: all) are hit. `exclude_body_ids` (R,) is a
        body per ray whose own geoms are ignored (-1: none). Hits beyond `max_distances` (R,)
        are misses. Planes are hit from above only, meshes and height fields from outside only. Results of
        environments outside `env_ids` (n,) may be misses.
        """
        query = RayQuery(origins, directions, geom_groups, exclude_body_ids, max_distances, env_ids)
        return self._engine.raycast(query)

    def render(self, views: tuple[CameraView, ...]) -> list[Images]:
        """Render views at the poses of the last `forward`; see `CameraView`, `Images`.

        Camera sensors render in `sense`. The images are overwritten by the next call.
        """
        return self._engine.render(views)

    def jacobian(
        self, points: torch.Tensor, body_ids: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return translational and rotational Jacobians, (N, 3, nv), of world points, (N, 3).

        `body_ids` (N,) int32 is the body each point is attached to. Like `xpos` and all derived
        fields, Jacobians belong to the state before the last substep, until `forward`.

        A degree of freedom with motion axis (w, v) at the center of mass c of the body's tree moves
        a point p with velocity v + w x (p - c).
        """
        # Not computed by the engine from the current qpos: within a step, qpos is one substep newer
        # than the positions of the points.
        body_ids = body_ids.long()
        envs = torch.arange(self.num_envs, device=self.device)
        centers = self.data.subtree_com[envs, self._body_roots[body_ids]]
        axes = self.data.cdof * self._moving_dofs[body_ids][..., None]
        rotational, translational = axes.split(3, dim=-1)
        arms = (points.float() - centers)[:, None].expand_as(rotational)
        translational = translational + torch.linalg.cross(rotational, arms)
        return translational.mT, rotational.mT

    def mass_matrix(self) -> torch.Tensor:
        """Return the joint-space inertia matrix, (N, nv, nv), armature included.

        Like `xpos`, of the state before the last substep, until `forward`.
        """
        rows, columns = self._mass_entries
        matrix = self.data.M.new_zeros(self.num_envs, self.mj_model.nv, self.mj_model.nv)
        matrix[:, rows, columns] = matrix[:, columns, rows] = self.data.M
        return matrix

    def copy_to_host(self, env_idx: int, mj_data: mujoco.MjData | None = None) -> mujoco.MjData:
        """Copy the state of one environment to host data, for viewers, without a forward pass."""
        mj_data = self.mj_data if mj_data is None else mj_data
        self._engine.copy_to_host(env_idx, mj_data)
        return mj_data

    # Exact resume.

    def state_dict(self) -> dict[str, Any]:
        """Return the physics state and per-environment model fields of all environments."""
        return {"engine": self.engine_name, **self._engine.state_dict()}

    def check_state(self, state: dict[str, Any]) -> None:
        """Raise `ValueError` if the engine, its release or the size of `state` does not match."""
        if state["engine"] != self.engine_name:
            raise ValueError(
                f"Saved physics state: expected engine {self.engine_name!r}, got "
                f"{state['engine']!r}; use --engine {state['engine']}."
            )
        self._engine.check_state(state)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict`. Raises `ValueError` before any change, as `check_state` does."""
        self.check_state(state)
        self.expand_model_fields(tuple(state["model"]))
        self._engine.load_state_dict(state)
        self._notify_forward("acc")

    def close(self) -> None:
        """Release engine resources that Python does not manage."""
        self._engine.close()

    def resolve_ids(self, env_ids: EnvIds) -> torch.Tensor | None:
        """Return `env_ids` for the engine: None (all), or int64, sorted and unique on a CPU."""
        if env_ids is None or (isinstance(env_ids, slice) and env_ids == slice(None)):
            return None
        ids = as_ids(env_ids, self.num_envs, self.device)
        # Not sorted on a GPU: the host would wait for the device.
        return ids if ids.is_cuda else torch.where(ids < 0, ids + self.num_envs, ids).unique()


class SharedField(torch.Tensor):
    """Model value shared by all environments. Writing makes it the engine's live tensor.

    Operations return plain tensors, except views: these follow the field, so that references taken
    before a write stay valid.
    """

    live: Callable[[bool], torch.Tensor | None]
    """Returns the live tensor, for reading or (True) writing; None: read the shared value."""

    @classmethod
    def make(
        cls,
        value: torch.Tensor,
        nworld: int | None,
        live: Callable[[bool], torch.Tensor | None],
    ) -> SharedField:
        """View `value` as a field of shape (nworld, ...); unchanged shape (structure) if None."""
        view = value if nworld is None else value.expand(nworld, *value.shape)
        field = torch.Tensor._make_subclass(cls, view)
        field.live = live
        return field

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = getattr(func, "__name__", "")
        writes = name == "__setitem__" or (name.endswith("_") and not name.endswith("__"))
        with torch._C.DisableTorchFunctionSubclass():
            first = [_follow(value, writes) for value in args[:1]]
            rest = [_follow(value, False) for value in args[1:]]
            options = {key: _follow(value, key == "out") for key, value in (kwargs or {}).items()}
            result = func(*first, *rest, **options)
            field = args[0] if args else None
            if not isinstance(field, SharedField) or field.live(False) is not None:
                return result
            # A view of the shared value follows the field too.
            if isinstance(result, np.ndarray):
                result.flags.writeable = False
                return result

            def view(base: torch.Tensor) -> Any:
                with torch._C.DisableTorchFunctionSubclass():
                    return func(base, *rest, **options)

            if type(result) not in (tuple, list):
                return _follower(result, field, view)
            parts = (
                _follower(part, field, lambda base, k=k: view(base)[k])
                for k, part in enumerate(result)
            )
            return type(result)(parts)


def _follow(value: Any, writes: bool) -> Any:
    """Replace shared fields in an argument of a torch function by plain tensors: live or shared."""
    if isinstance(value, SharedField):
        live = value.live(writes)
        return value.as_subclass(torch.Tensor) if live is None else live
    if type(value) in (tuple, list):
        return type(value)(_follow(part, writes) for part in value)
    return value


def _follower(result: Any, field: SharedField, view: Callable[[torch.Tensor], Any]) -> Any:
    """Return `result` as a shared field if it is a view of `field`; other results unchanged."""
    # Empty tensors all have the same address.
    if not (
        isinstance(result, torch.Tensor)
        and result.numel()
        and result.untyped_storage().data_ptr() == field.untyped_storage().data_ptr()
    ):
        return result

    def live(writes: bool) -> torch.Tensor | None:
        base = field.live(writes)
        return None if base is None else view(base)

    return SharedField.make(result, None, live)


def _reshape_rows(field: str, tensor: torch.Tensor) -> torch.Tensor:
    """View a model field that MuJoCo stores flat as rows of matrices."""
    shape = _ROW_SHAPES.get(field)
    is_flat = shape is not None and tensor.shape[-1] == math.prod(shape)
    return tensor.unflatten(-1, shape) if is_flat else tensor
