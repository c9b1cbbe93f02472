"""The facade over the physics engine: one class, whichever engine runs below it."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import torch

from mjlab.sim.config import SimulationCfg
from mjlab.sim.engine import (
    COLLISION_MASKS,
    CameraView,
    Capabilities,
    EngineUnavailableError,
    Images,
    Stage,
    create_engine,
    resolve_engine_name,
)
from mjlab.sim.fields import FieldView, SharedField
from mjlab.sim.randomization import RecomputeLevel, VariantInfo, VariantValues
from mjlab.utils.nan_guard import NanGuard

logger = logging.getLogger(__name__)

EnvIds = torch.Tensor | slice | None


class Simulation:
    """N copies of one MuJoCo model, advanced together by the configured engine.

    Fields are `sim.data.<field>` and `sim.model.<field>`: torch tensors (float32, int32 or bool)
    with MuJoCo's names and a leading environment dimension, live and written in place; rotation
    matrices are (..., 3, 3).

    After `step`, `qpos`, `qvel`, `act` and `time` are current, and every derived field (`xpos`,
    `cvel`, `sensordata`, ...) belongs to the state before the last physics substep. After
    `forward` all are current.
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
            ValueError: `num_envs` below 1, neither or both of model and spec, unknown options, or
                an XML that does not compile (MuJoCo's message is passed on), or variants that
                differ in what the engine cannot hold per environment.
            EngineUnavailableError: the chosen engine cannot run on `device`.
        """
        if num_envs < 1:
            raise ValueError(f"The number of environments is {num_envs}; it has to be at least 1.")
        if (model is None) == (spec is None):
            raise ValueError("Give Simulation exactly one of `model` and `spec`.")
        engine_name = resolve_engine_name(cfg.engine, device)
        self.num_envs = num_envs
        self.cfg = cfg
        self.device = device
        self._mj_model = compile_spec(spec) if spec is not None else model
        assert self._mj_model is not None
        cfg.mujoco.apply(self._mj_model)
        self._mj_data = mujoco.MjData(self._mj_model)
        mujoco.mj_forward(self._mj_model, self._mj_data)
        # Viewers write an environment's values into the host model, so the defaults that
        # randomization starts from are a snapshot.
        self._default_model = copy.copy(self._mj_model)
        self._default_fields: dict[str, torch.Tensor] = {}
        self._variants: VariantValues | None = None
        self._engine = create_engine(engine_name, self._mj_model, num_envs, cfg, device)
        self._data = FieldView(self._engine.data_field, num_envs, "data")
        self._model = FieldView(self._lookup_model_field, num_envs, "model")
        self._expanded: set[str] = set()
        if variant_info:
            self._apply_variants(variant_info)
        self._forward_callbacks: list[Callable[[], None]] = []
        self._sensor_context: Any = None
        self.nan_guard = NanGuard(
            cfg.nan_guard,
            num_envs,
            self._mj_model,
            model_fields=lambda: {name: getattr(self._model, name) for name in self._expanded},
        )
        logger.debug("Physics: %s, %d environments.", self.capabilities.description, num_envs)

    # What there is.

    @property
    def capabilities(self) -> Capabilities:
        """What the engine is and can do."""
        return self._engine.capabilities

    @property
    def engine_name(self) -> str:
        """`native` or `warp`."""
        return self.capabilities.name

    @property
    def data(self) -> FieldView:
        """Live `MjData` fields, (N, ...)."""
        return self._data

    @property
    def model(self) -> FieldView:
        """Live `MjModel` fields, (N, ...); those not expanded are shared and read-only."""
        return self._model

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The compiled model on the host. Randomized values are not in it."""
        return self._mj_model

    @property
    def mj_data(self) -> mujoco.MjData:
        """Host data of the compiled model, forwarded once at `qpos0`."""
        return self._mj_data

    @property
    def wp_model(self) -> Any:
        """MuJoCo Warp's model; AttributeError on another engine."""
        return self._warp_struct("wp_model")

    @property
    def wp_data(self) -> Any:
        """MuJoCo Warp's data; AttributeError on another engine."""
        return self._warp_struct("wp_data")

    def _warp_struct(self, name: str) -> Any:
        if self.engine_name != "warp":
            raise AttributeError(
                f"Simulation.{name} exists on the warp engine only; this is {self.engine_name}. "
                "Use sim.data and sim.model, which work on both."
            )
        return getattr(self._engine, name)

    # Model fields.

    @property
    def expanded_fields(self) -> set[str]:
        """Names of model fields that each environment has for itself."""
        return set(self._expanded)

    @property
    def per_world_default_fields(self) -> set[str]:
        """Fields whose compile-time value differs between environments, because of variants."""
        return set() if self._variants is None else set(self._variants.fields)

    @property
    def world_to_variant(self) -> dict[str, torch.Tensor]:
        """Variant index of each environment, (N,) int64, by entity; empty without variants."""
        if self._variants is None:
            return {}
        return {
            name: torch.as_tensor(ids, dtype=torch.int64, device=self.device)
            for name, ids in self._variants.world_to_variant.items()
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
        if field not in self._default_fields:
            self._default_fields[field] = self._host_field(field)
        return self._default_fields[field]

    def _host_field(self, field: str) -> torch.Tensor:
        source: Any = self._default_model
        if not hasattr(source, field) and hasattr(source.opt, field):
            source = source.opt
        value = getattr(source, field, None)
        if field in self.per_world_default_fields:
            assert self._variants is not None
            value = self._variants.get(field)
        if field.startswith("_") or value is None or callable(value):
            raise ValueError(
                f"MjModel has no field {field!r}. Fields carry MuJoCo's names, such as "
                "'body_mass' or 'geom_friction'."
            )
        array = np.array(value)
        if array.dtype == np.float64:
            array = array.astype(np.float32)
        if field.endswith("mat0") and array.shape[-1:] == (9,):
            array = array.reshape(*array.shape[:-1], 3, 3)
        return torch.from_numpy(array).to(self.device)

    def _lookup_model_field(self, name: str) -> torch.Tensor:
        if self._engine.is_expanded(name):
            return self._engine.model_field(name)
        try:
            value = self.get_default_field(name)
        except ValueError as error:
            raise AttributeError(str(error)) from error
        return SharedField.make(value, self.num_envs, name)

    def _apply_variants(self, info: list[tuple[str, VariantInfo]]) -> None:
        """Give every environment the model fields of its own variants."""
        derived = self._engine.constants_written_by(3)
        variants = VariantValues(self._default_model, self.num_envs, info, derived)
        self._variants = variants
        for name in variants.fields:
            try:
                self.expand_model_fields((name,))
            except ValueError as error:
                raise ValueError(variants.describe_error(name, error)) from error
        # The mean inertia, which is no field, scales the solver's tolerance.
        self.recompute_constants(3)
        for name in dict.fromkeys((*variants.fields, *derived)):
            self._engine.model_field(name).copy_(self.get_default_field(name))
        if self.absent_geoms is not None:
            self._engine.hide_geoms(self.absent_geoms)
            self._expanded.update(COLLISION_MASKS)
        self._engine.forward(None)

    def expand_model_fields(self, fields: tuple[str, ...] | list[str]) -> None:
        """Give every environment its own copy of model fields, starting from the shared values.

        Do this before anything keeps a reference to `sim.model.<field>`: the tensor is a new one.

        Raises:
            ValueError: no such field, or one that the engine cannot hold per environment.
        """
        new = tuple(name for name in fields if name not in self._expanded)
        for name in new:
            self.get_default_field(name)
        self._engine.expand(new)
        self._expanded.update(new)
        self._model.forget(new)

    def recompute_constants(self, level: RecomputeLevel | int, env_ids: EnvIds = None) -> None:
        """Recompute what derives from changed model fields, as `mj_setConst` does.

        `qpos` and `qvel` stay; derived fields are those of the reference pose until the next
        `forward`. Every field that the recomputation writes becomes per-environment.
        """
        if int(level) == 0:
            return
        self.expand_model_fields(self._engine.constants_written_by(int(level)))
        self._engine.recompute_constants(int(level), self.resolve_ids(env_ids))

    # Physics.

    def step(self, nstep: int = 1) -> None:
        """Advance all environments by `nstep` substeps, in one dispatch."""
        if not self.nan_guard.enabled:
            self._engine.step(nstep)
            return
        for _ in range(nstep):
            with self.nan_guard.watch(self._data):
                self._engine.step(1)

    def forward(self, env_ids: EnvIds = None, stage: Stage = "acc") -> None:
        """Make derived fields up to a stage current with the state, without advancing time.

        `"pos"`: positions and contacts. `"vel"`: velocities too. `"acc"`: everything. Fields and
        sensors of later stages keep their values.
        """
        self._engine.forward(self.resolve_ids(env_ids), stage)
        for callback in self._forward_callbacks:
            callback()

    def reset(self, env_ids: EnvIds = None) -> None:
        """Put environments into the model's initial state: time 0, `qpos0`, the rest zero.

        Derived fields and model fields keep their values until `forward`.
        """
        self._engine.reset(self.resolve_ids(env_ids))

    def add_forward_callback(self, callback: Callable[[], None]) -> None:
        """Call `callback` after every `forward`: what was cached from derived fields is stale."""
        self._forward_callbacks.append(callback)

    def sense(self) -> None:
        """Evaluate camera and ray sensors at the current poses; nothing without such sensors."""
        if self._sensor_context is not None:
            self._sensor_context.sense(self.raycast, self.render)

    def set_sensor_context(self, ctx: Any) -> None:
        """Set the object whose `sense(raycast, render)` evaluates camera and ray sensors.

        Raises:
            EngineUnavailableError: it has ray sensors, and the engine casts no rays in this model;
                or it has cameras, and the engine does not render this model.
        """
        for is_needed, problem in (
            (ctx.has_raycasts, self.capabilities.raycast_problem),
            (ctx.has_cameras, self.capabilities.render_problem),
        ):
            if is_needed and problem is not None:
                raise EngineUnavailableError(problem)
        self._sensor_context = ctx
        ctx.set_render_context_source(self.render_context)

    def create_graph(self) -> None:
        """Capture the step anew where the engine captures one (Warp on CUDA); else nothing."""
        capture = getattr(self._engine, "create_graph", None)
        if capture is not None:
            capture()

    # Queries.

    def raycast(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        geom_groups: tuple[int, ...] | None = None,
        exclude_body_ids: torch.Tensor | None = None,
        max_distances: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Cast rays: (N, R, 3) world origins and unit directions.

        Returns distances (N, R) with -1 on a miss, normals (N, R, 3) with 0, geom ids (N, R) with
        -1. Only geoms of `geom_groups` (None: all) are hit; `exclude_body_ids` (R,) names a body
        per ray whose own geoms are not (-1: none); what is farther than `max_distances` (R,) is a
        miss. Planes are hit from above only, meshes and height fields from outside only.
        """
        return self._engine.raycast(
            origins, directions, geom_groups, exclude_body_ids, max_distances
        )

    def render(self, views: tuple[CameraView, ...]) -> list[Images]:
        """Render what cameras see at the poses of the last `forward`; see `CameraView`, `Images`.

        Camera sensors do this in `sense`. The images are overwritten by the next call.
        """
        return self._engine.render(views)

    def render_context(self, views: tuple[CameraView, ...], view: CameraView) -> Any:
        """Return MuJoCo Warp's context of a view, one of `views` that were rendered together.

        AttributeError on another engine, RuntimeError before the first rendering.
        """
        if self.engine_name != "warp":
            raise AttributeError(
                f"A render context exists on the warp engine only; this is {self.engine_name}. "
                "Read images from the camera sensors, which work on both."
            )
        engine: Any = self._engine
        return engine.render_context(views, view)

    def jacobian(
        self, points: torch.Tensor, body_ids: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return translational and rotational Jacobians (N, 3, nv) of (N, 3) world points.

        `body_ids` (N,) int32 says which body each point moves with. Like `xpos` and all derived
        fields, they belong to the state before the last substep, until `forward`.
        """
        return self._engine.jacobian(points, body_ids)

    def copy_to_host(self, env_idx: int, mj_data: mujoco.MjData | None = None) -> mujoco.MjData:
        """Copy the state of one environment into host data, for viewers; runs no forward pass."""
        mj_data = self._mj_data if mj_data is None else mj_data
        self._engine.copy_to_host(env_idx, mj_data)
        return mj_data

    # Exact resume.

    def state_dict(self) -> dict[str, Any]:
        """Return the physics state of all environments and their own model fields."""
        return {"engine": self.engine_name, **self._engine.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict`; raises ValueError if it comes from another engine or size."""
        if state["engine"] != self.engine_name:
            raise ValueError(
                f"The saved simulation state is of the {state['engine']} engine; this one is "
                f"{self.engine_name}."
            )
        self.expand_model_fields(tuple(state["model"]))
        self._engine.load_state_dict(state)
        for callback in self._forward_callbacks:
            callback()

    def close(self) -> None:
        """Free what the engine holds outside Python's reach."""
        self._engine.close()

    def resolve_ids(self, env_ids: EnvIds) -> torch.Tensor | None:
        """Return `env_ids` as the engine takes them: None, or sorted unique int64 on the device."""
        if env_ids is None:
            return None
        if isinstance(env_ids, slice):
            if env_ids == slice(None):
                return None
            return torch.arange(self.num_envs, device=self.device)[env_ids].sort().values
        if env_ids.dtype == torch.bool:
            return env_ids.nonzero().flatten()
        if env_ids.numel() < 2:
            return env_ids.to(self.device, torch.int64)
        return torch.unique(env_ids.to(self.device, torch.int64), sorted=True)


def compile_spec(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile `spec` so that inertial frames may differ between environments afterwards.

    Raises:
        ValueError: the spec does not compile, with MuJoCo's message.
    """
    for body in spec.bodies:
        # The compiler's shortcut for free bodies fixes the sparsity of the mass matrix, which a
        # randomized centre of mass would need in full.
        body.simple = 0
    try:
        return spec.compile()
    except ValueError as error:
        raise ValueError(f"The scene does not compile: {error}") from error
