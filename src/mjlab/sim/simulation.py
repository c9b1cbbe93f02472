"""Facade over the physics engine: one class, whichever engine runs below it."""

from __future__ import annotations

import contextlib
import copy
import logging
import math
from collections.abc import Callable, Generator
from functools import cached_property, partial
from typing import Any

import mujoco
import numpy as np
import torch

from mjlab.sim.config import SimulationCfg
from mjlab.sim.engine import (
    CameraView,
    Capabilities,
    EngineUnavailableError,
    Images,
    RayHits,
    RayQuery,
    Stage,
    create_engine,
    resolve_engine_name,
)
from mjlab.sim.memory import bytes_per_environment, check_memory
from mjlab.sim.randomization import RecomputeLevel, VariantInfo, VariantValues, is_structure
from mjlab.sim.sim_data import FieldView
from mjlab.sim.warning_log import collect_mujoco_warnings
from mjlab.utils.errors import UnknownAttributeError, WrongStateError, check_positive
from mjlab.utils.indexing import EnvIds, as_ids
from mjlab.utils.mujoco import moving_dofs
from mjlab.utils.nan_guard import NanGuard
from mjlab.utils.spec import compile_spec

logger = logging.getLogger(__name__)

# Shapes of rows that MuJoCo stores flat, as MuJoCo Warp has them.
_ROW_SHAPES = {"cam_mat0": (3, 3), "geom_aabb": (2, 3)}


class Simulation:
    """N copies of one MuJoCo model, advanced together by the configured engine.

    Fields are `sim.data.<field>` and `sim.model.<field>`: torch tensors (float32, int32 or bool)
    with MuJoCo's names and a leading environment dimension, live and written in place. Rotation
    matrices are (..., 3, 3), and `geom_aabb` is (N, ngeom, 2, 3): center and half sizes. Sizes
    (`model.nv`) are ints. Structure (addresses, ids, types, flags, assets: `model.geom_bodyid`) has
    no environment dimension as long as it is not expanded. Options are `sim.model.opt.<field>`:
    real numbers (N, ...), whole numbers ints.

    After `step`, `qpos`, `qvel`, `act` and `time` are current, and every derived field (`xpos`,
    `cvel`, `sensordata`, ...) belongs to the state before the last physics substep. After
    `forward` all are current up to its stage; with `stage="vel"`, forces, accelerations and their
    sensors remain those of that substep.
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
        """Compile (from `spec`) or take (`model`) a MuJoCo model and allocate `num_envs` copies.

        `variant_info` has the name and the `variant_metadata` of each entity that is another thing
        in each environment; the model has to be compiled from the spec that they are in.

        Raises:
            ValueError: `num_envs` below 1 or beyond the memory, neither or both of model and spec, unknown options, or
                an XML that does not compile (MuJoCo's message is passed on), or variants that
                differ in what the engine cannot hold per environment.
            EngineUnavailableError: the chosen engine cannot run on `device`.
        """
        check_positive("num_envs", num_envs)
        if (model is None) == (spec is None):
            raise ValueError("Give Simulation exactly one of `model` and `spec`.")
        engine_name = resolve_engine_name(cfg.engine, device)
        collect_mujoco_warnings()
        self.num_envs = num_envs
        self.cfg = cfg
        self.device = device
        self.mj_model: mujoco.MjModel = compile_spec(spec) if spec is not None else model
        """The compiled model on the host. Randomized values are not in it."""
        cfg.mujoco.apply(self.mj_model)
        check_memory(num_envs, bytes_per_environment(self.mj_model, cfg, engine_name), device)
        self.mj_data = mujoco.MjData(self.mj_model)
        """Host data of the compiled model, forwarded once at `qpos0`."""
        mujoco.mj_forward(self.mj_model, self.mj_data)
        # Viewers write an environment's values into the host model, so the defaults that
        # randomization starts from are a snapshot.
        self._default_model = copy.copy(self.mj_model)
        self._default_fields: dict[str, torch.Tensor] = {}
        self._variants: VariantValues | None = None
        self._engine = create_engine(engine_name, self.mj_model, num_envs, cfg, device)
        self.data = FieldView(self._engine.data_field, num_envs, "data")
        """Live `MjData` fields, (N, ...)."""
        self.model = FieldView(self._read_model_field, num_envs, "model")
        """Live `MjModel` fields; those not expanded are shared and read-only."""
        self._options = FieldView(self._read_option, num_envs, "model.opt")
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
        logger.debug("Physics: %s, %d environments.", self.capabilities.description, num_envs)

    # Properties.

    @property
    def capabilities(self) -> Capabilities:
        """What the engine is and can do."""
        return self._engine.capabilities

    @property
    def engine_name(self) -> str:
        """`native` or `warp`."""
        return self.capabilities.name

    # Escape hatch of the Warp engine.

    @property
    def wp_model(self) -> Any:
        """MuJoCo Warp's model; AttributeError on another engine."""
        return self._warp_engine("wp_model", "sim.model").wp_model

    @property
    def wp_data(self) -> Any:
        """MuJoCo Warp's data; AttributeError on another engine."""
        return self._warp_engine("wp_data", "sim.data").wp_data

    @property
    def wp_device(self) -> Any:
        """Warp's device; AttributeError on another engine."""
        return self._warp_engine("wp_device", "sim.device").wp_device

    def render_context(self, views: tuple[CameraView, ...], view: CameraView) -> Any:
        """Return MuJoCo Warp's context of a view, one of `views` that were rendered together.

        AttributeError on another engine, RuntimeError before the first rendering.
        """
        engine = self._warp_engine("render_context", "the images of camera sensors")
        return engine.renderer.context_of(views, view)

    def _warp_engine(self, name: str, instead: str) -> Any:
        if self.engine_name != "warp":
            raise UnknownAttributeError(
                f"Simulation.{name} exists on the warp engine only, and this is "
                f"{self.engine_name}; use {instead}, which works on both."
            )
        return self._engine

    # Model fields.

    @property
    def expanded_fields(self) -> set[str]:
        """Names of model fields that each environment has for itself."""
        return set(self._engine.model_fields)

    @property
    def per_world_default_fields(self) -> set[str]:
        """Fields whose compile-time value differs between environments, because of variants."""
        return set() if self._variants is None else set(self._variants.fields)

    @property
    def world_to_variant(self) -> dict[str, torch.Tensor]:
        """Variant index of each environment, (N,) int64, by entity; empty without variants."""
        variants = {} if self._variants is None else self._variants.world_to_variant
        return {
            name: torch.as_tensor(ids, dtype=torch.int64, device=self.device)
            for name, ids in variants.items()
        }

    @cached_property
    def absent_geoms(self) -> torch.Tensor | None:
        """(N, ngeom) bool: geoms that an environment's variants do not have; None if there are none.

        Such a geom touches nothing and is not seen. Its fields must not be written.
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

        With it for `per_world_default_fields`: what the variants of each environment compile to.

        The baseline for randomization by scaling or adding, so that it never drifts. float32 where
        MuJoCo has doubles. Raises ValueError for a field that does not exist.
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
                f"MjModel has no field {field!r}. Fields carry MuJoCo's names, such as "
                "'body_mass' or 'geom_friction'; structs are those of sim.mj_model."
            )
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
        rows = None if is_structure(name, np.asarray(value)) else self.num_envs
        return SharedField.make(self.get_default_field(name), rows, name)

    def _read_option(self, name: str) -> Any:
        if not hasattr(self._default_model.opt, name):
            raise UnknownAttributeError(f"MjOption has no field {name!r}.")
        return self._read_model_field(name)

    def _apply_variants(self, info: list[tuple[str, VariantInfo]]) -> None:
        """Give every environment the model fields of its own variants."""
        derived = self._engine.constants_written_by(3)
        variants = VariantValues(self._default_model, self.num_envs, info, derived)
        self._variants = variants
        for name in variants.fields:
            try:
                self.expand_model_fields((name,))
            except ValueError as error:
                names = ", ".join(repr(entity) for entity, _ in info)
                raise ValueError(
                    f"The variants of entity {names} differ in the model field {name!r}: {error}"
                ) from error
        # The mean inertia, which is not a field, scales the solver's tolerance.
        self.recompute_constants(3)
        for name in dict.fromkeys((*variants.fields, *derived)):
            getattr(self.model, name).copy_(self.get_default_field(name))
        if self.absent_geoms is not None:
            self._engine.hide_geoms(self.absent_geoms)
        self._engine.forward(None)

    def expand_model_fields(self, fields: tuple[str, ...] | list[str]) -> None:
        """Give every environment its own copy of model fields, starting from the shared values.

        Options go by their own name (`gravity`) or as `opt.gravity`.

        Do this before anything keeps a reference to `sim.model.<field>`: the tensor is a new one.

        Raises:
            ValueError: no such field, or one that the engine cannot hold per environment.
        """
        names = (name.removeprefix("opt.") for name in fields)
        new = tuple(name for name in names if name not in self._engine.model_fields)
        for name in new:
            self.get_default_field(name)
        self._engine.expand(new)
        self.model.forget(new)
        self._options.forget(new)

    def expand_constants(self, level: RecomputeLevel | int) -> None:
        """Expand the model fields that `recompute_constants(level)` writes."""
        self.expand_model_fields(self._engine.constants_written_by(int(level)))

    def recompute_constants(self, level: RecomputeLevel | int, env_ids: EnvIds = None) -> None:
        """Recompute what derives from changed model fields, as `mj_setConst` does.

        `qpos` and `qvel` stay; derived fields are those of the reference pose until the next
        `forward`. Every field that the recomputation writes becomes per-environment.
        """
        if int(level) == 0:
            return
        self.expand_constants(level)
        self._engine.recompute_constants(int(level), self.resolve_ids(env_ids))

    # Physics.

    def step(self, nstep: int = 1, record: tuple[str, ...] = ()) -> dict[str, torch.Tensor]:
        """Advance all environments by `nstep` substeps, in one dispatch.

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
        """Make derived fields up to a stage current with the state, without advancing time.

        `"pos"`: positions. `"vel"`: velocities too. `"acc"`: everything. Fields and
        sensors of later stages keep their values.
        """
        self._engine.forward(self.resolve_ids(env_ids), stage)
        self._notify_forward(stage)

    def forward_after_reset(self, env_ids: torch.Tensor) -> None:
        """Run `forward(env_ids)`, and `forward(stage="vel")` for the other environments.

        On Warp this costs one forward pass instead of two.
        """
        resolved = self.resolve_ids(env_ids)
        assert resolved is not None
        self._engine.forward_after_reset(resolved)
        self._notify_forward("acc")

    @contextlib.contextmanager
    def looking_ahead(self, env_ids: torch.Tensor) -> Generator[None]:
        """Make positions and velocities current in some environments, for the length of the block.

        After it, derived fields and the results of camera and ray sensors are what they were
        before. In the block, fields of other environments may be current or not.

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
        """Return where the last step left a state that MuJoCo calls bad, (N,) bool.

        Positions, velocities or accelerations are not finite, or beyond `mjMAXVAL` (1e10).
        """
        return self._engine.bad_states()

    def bad_dof(self, env_idx: int) -> int | None:
        """Return the degree of freedom at which MuJoCo found the state bad; None if it is not known."""
        return self._engine.bad_dof(env_idx)

    def reset(self, env_ids: EnvIds = None) -> None:
        """Put environments into the model's initial state: time 0, `qpos0`, the rest zero.

        Derived fields and model fields keep their values until `forward`.
        """
        self._engine.reset(self.resolve_ids(env_ids))

    def add_forward_callback(self, callback: Callable[[Stage], None]) -> None:
        """Call `callback(stage)` after every `forward`: derived fields up to a stage have changed."""
        self._forward_callbacks.append(callback)

    def _notify_forward(self, stage: Stage) -> None:
        for callback in self._forward_callbacks:
            callback(stage)

    def sense(self, env_ids: torch.Tensor | None = None) -> None:
        """Evaluate camera and ray sensors at the current poses; nothing without such sensors.

        Args:
            env_ids: Environments (n,) int64 that need results; others may get misses. None: all.
        """
        if self._sensor_context is not None:
            raycast = self.raycast if env_ids is None else partial(self.raycast, env_ids=env_ids)
            self._sensor_context.sense(raycast, self.render)

    def set_sensor_context(self, ctx: Any) -> None:
        """Set the object whose `sense(raycast, render)` evaluates camera and ray sensors.

        Raises:
            EngineUnavailableError: it has ray sensors, and the engine casts no rays in this model;
                or it has cameras, and the engine does not render this model.
        """
        problem = ctx.has_raycasts and self.capabilities.raycast_problem
        problem = problem or (ctx.has_cameras and self.capabilities.render_problem)
        if problem:
            raise EngineUnavailableError(problem)
        self._sensor_context = ctx
        ctx.set_render_context_source(self.render_context)

    def create_graph(self) -> None:
        """Capture graphs of `step` and `forward` again (Warp on CUDA); no effect elsewhere.

        Environments call this once, at the end of their construction. State, results and overflow
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
        """Cast rays: (N, R, 3) world origins and unit directions.

        Returns distances (N, R) with -1 on a miss, normals (N, R, 3) with 0, geom ids (N, R) with
        -1. Only geoms of `geom_groups` (None: all) are hit; `exclude_body_ids` (R,) names a body
        per ray whose own geoms are not (-1: none); what is farther than `max_distances` (R,) is a
        miss. Planes are hit from above only, meshes and height fields from outside only. Results of
        environments that are not in `env_ids` (n,), if given, may be misses.
        """
        query = RayQuery(origins, directions, geom_groups, exclude_body_ids, max_distances, env_ids)
        return self._engine.raycast(query)

    def render(self, views: tuple[CameraView, ...]) -> list[Images]:
        """Render what cameras see at the poses of the last `forward`; see `CameraView`, `Images`.

        Camera sensors do this in `sense`. The images are overwritten by the next call.
        """
        return self._engine.render(views)

    def jacobian(
        self, points: torch.Tensor, body_ids: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return translational and rotational Jacobians (N, 3, nv) of (N, 3) world points.

        `body_ids` (N,) int32 says which body each point moves with. Like `xpos` and all derived
        fields, they belong to the state before the last substep, until `forward`.

        A degree of freedom with motion axis (w, v) at the center of mass c of the body's tree moves
        a point p with v + w x (p - c).
        """
        # Not by the engine from the present qpos, which in the middle of a step is one substep newer
        # than the positions that the points come from.
        roots, moves = self._body_motion
        body_ids = body_ids.long()
        envs = torch.arange(self.num_envs, device=self.device)
        centers = self.data.subtree_com[envs, roots[body_ids]]
        axes = self.data.cdof * moves[body_ids][..., None]
        rotational, translational = axes.split(3, dim=-1)
        arms = (points.float() - centers)[:, None].expand_as(rotational)
        translational = translational + torch.linalg.cross(rotational, arms)
        return translational.mT, rotational.mT

    @cached_property
    def _body_motion(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Root of each body, (nbody,), and whether it moves with a degree of freedom, (nbody, nv)."""
        roots = torch.as_tensor(self.mj_model.body_rootid, dtype=torch.int64, device=self.device)
        moves = torch.as_tensor(moving_dofs(self.mj_model), dtype=torch.float32, device=self.device)
        return roots, moves

    def copy_to_host(self, env_idx: int, mj_data: mujoco.MjData | None = None) -> mujoco.MjData:
        """Copy the state of one environment into host data, for viewers; runs no forward pass."""
        mj_data = self.mj_data if mj_data is None else mj_data
        self._engine.copy_to_host(env_idx, mj_data)
        return mj_data

    # Exact resume.

    def state_dict(self) -> dict[str, Any]:
        """Return the physics state of all environments and their own model fields."""
        return {"engine": self.engine_name, **self._engine.state_dict()}

    def check_state(self, state: dict[str, Any]) -> None:
        """Raise ValueError if `state` is of another engine, another release of it or another size."""
        if state["engine"] != self.engine_name:
            raise ValueError(
                f"The saved physics state is of the {state['engine']} engine; this one is "
                f"{self.engine_name}. Use --engine {state['engine']}."
            )
        self._engine.check_state(state)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict`; raises ValueError, and changes nothing, as `check_state` does."""
        self.check_state(state)
        self.expand_model_fields(tuple(state["model"]))
        self._engine.load_state_dict(state)
        self._notify_forward("acc")

    def close(self) -> None:
        """Free what the engine holds outside Python's reach."""
        self._engine.close()

    def resolve_ids(self, env_ids: EnvIds) -> torch.Tensor | None:
        """Return `env_ids` as the engine takes them: None, or int64, on a CPU sorted and unique."""
        if env_ids is None or (isinstance(env_ids, slice) and env_ids == slice(None)):
            return None
        ids = as_ids(env_ids, self.num_envs, self.device)
        # To sort them, the host would have to wait for a GPU.
        return ids if ids.is_cuda or len(ids) < 2 else ids.unique()


class SharedField(torch.Tensor):
    """Model value that all environments share: reading is free, writing raises `RuntimeError`.

    Writing one row would change every environment. Results of operations are plain tensors.
    """

    error: str

    @classmethod
    def make(cls, value: torch.Tensor, nworld: int | None, name: str) -> SharedField:
        """View `value` as an (nworld, ...) field; as structure, in its own shape, if None."""
        view = value if nworld is None else value.expand(nworld, *value.shape)
        field = torch.Tensor._make_subclass(cls, view)
        field.error = f"Model field {name!r} is shared by all environments and cannot be written. "
        field.error += (
            "Change it in the spec or the model from which the Simulation is built."
            if nworld is None
            else f"Call sim.expand_model_fields(({name!r},)) first, or declare it with "
            f"@requires_model_fields({name!r})."
        )
        return field

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        target = args[0] if args else None
        name = getattr(func, "__name__", "")
        writes = name == "__setitem__" or (name.endswith("_") and not name.endswith("__"))
        out = (kwargs or {}).get("out")
        outputs = out if isinstance(out, tuple | list) else (out,)
        for tensor in (target, *outputs) if writes else outputs:
            if isinstance(tensor, SharedField):
                raise WrongStateError(tensor.error)
        with torch._C.DisableTorchFunctionSubclass():
            result = func(*args, **(kwargs or {}))
        # Views still alias the shared value, so they stay protected. Without elements all tensors
        # have the same address.
        if isinstance(target, SharedField):
            if isinstance(result, np.ndarray):
                result.flags.writeable = False
            elif (
                isinstance(result, torch.Tensor)
                and result.numel()
                and result.untyped_storage().data_ptr() == target.untyped_storage().data_ptr()
            ):
                result = result.as_subclass(cls)
                result.error = target.error
        return result


def _reshape_rows(field: str, tensor: torch.Tensor) -> torch.Tensor:
    """View a model field whose rows MuJoCo stores flat as rows of matrices."""
    shape = _ROW_SHAPES.get(field)
    is_flat = shape is not None and tensor.shape[-1] == math.prod(shape)
    return tensor.unflatten(-1, shape) if is_flat else tensor
