"""Native engine: MuJoCo's batch engine (`mujoco.batch`) on CPU threads.

A simulation is a float64 state row of `mujoco.batch.Batch`. Callers see float32 copies of the
fields they read. Before a call, elements written since the last call are copied into the rows; all
other elements keep their precision. After a call, the computed fields are copied out. A field costs
time only after its first read.
"""

from __future__ import annotations

import contextlib
import copy
import logging
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch
from mujoco.batch import MODEL_FIELDS, Batch, SimulationError

from mjlab.sim.engine import (
    ACCELERATION_FIELDS,
    COLLISION_MASKS,
    CONSTANTS_AT_QPOS0,
    FIXED_CONSTANTS,
    INPUTS,
    RESULTS_ZERO_ON_RESET,
    ROTATION_MATRICES,
    STAGES,
    VELOCITY_FIELDS,
    Capabilities,
    Engine,
    EngineUnavailableError,
    Stage,
)
from mjlab.sim.native.rays import NativeRays
from mjlab.sim.native.render import NativeRenderer, render_problem
from mjlab.utils.errors import UnknownAttributeError, WrongStateError, check_count
from mjlab.utils.processes import cores_per_process

if TYPE_CHECKING:
    from mjlab.sim.config import SimulationCfg
    from mjlab.sim.engine import CameraView, Images, RayHits, RayQuery

logger = logging.getLogger(__name__)

# State that a step advances; other state changes only when written.
_ADVANCED = frozenset({"time", "qpos", "qvel", "act", "qacc_warmstart"})

_DERIVED_CONSTANTS = (
    *FIXED_CONSTANTS,
    *CONSTANTS_AT_QPOS0,
    *("dof_M0", "flexedge_length0", "flexedge_invweight0"),
)

# The compiler marks coinciding frames, and MuJoCo skips their transforms. So marks must be cleared
# before such a frame is randomized.
_FRAME_MARKS = {
    "body_ipos": ("body_sameframe", "geom_sameframe", "site_sameframe"),
    "body_iquat": ("body_sameframe", "geom_sameframe", "site_sameframe"),
    "geom_pos": ("geom_sameframe",),
    "geom_quat": ("geom_sameframe",),
    "site_pos": ("site_sameframe",),
    "site_quat": ("site_sameframe",),
}
_INERTIAL_FRAME = ("body_ipos", "body_iquat")

# Integers in a model are addresses, types and masks. Array sizes and collision pairs are compiled
# from most of them, so a per-environment change would act in part or not at all. MuJoCo reads the
# integers listed here at run time only.
_FREE_INTEGERS = frozenset(
    {"geom_matid", "geom_dataid", "geom_condim", "geom_priority", "mat_texid", "mat_texuniform"}
    | {"site_matid", "tendon_matid", "light_active", "light_castshadow", "light_type"}
    | {"jnt_limited", "tendon_limited", "jnt_actfrclimited", "tendon_actfrclimited"}
    | {"actuator_ctrllimited", "actuator_forcelimited", "actuator_actlimited"}
)

# Inputs and results of mj_setConst's bounding volumes for the midphase.
_BOUNDED = (
    *("geom_size", "geom_pos", "geom_quat", "geom_aabb", "geom_margin", "geom_gap"),
    *("body_ipos", "body_iquat"),
)
_BOUNDING_VOLUMES = ("bvh_aabb", "body_margin")
# Memory of the volumes per environment above which the midphase is off instead (bytes). Those of
# meshes are in the same array, though they never change: 41 MB of a Unitree B2.
_MOST_BOUNDS = 2**20

# Position and velocity stages do not need contacts. Collision detection is half of the cost of
# these stages on Go1 and G1.
_WITHOUT_CONSTRAINTS = int(
    mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
)

# Maximum number of substeps per call; Python handles signals between calls.
_SUBSTEPS_PER_CALL = 100

# Columns of `Batch.warning`: index of the last warning, number of warnings.
_INDEX, _COUNT = 0, 1
_BAD_STATES = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
]

# Matrices of implicit integration, computed by steps only.
_STEP_FIELDS = frozenset({"qH", "qHDiagInv", "qDeriv", "qLU"})
# Outputs of later stages, by stage.
_LATER_FIELDS = {
    "pos": VELOCITY_FIELDS | ACCELERATION_FIELDS | _STEP_FIELDS,
    "vel": ACCELERATION_FIELDS | _STEP_FIELDS,
    "acc": _STEP_FIELDS,
}


class NativeEngine(Engine):
    """MuJoCo's C code with one thread pool for all environments. Bit-reproducible."""

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, cfg: SimulationCfg, device: str
    ) -> None:
        check_count("SimulationCfg.num_threads", cfg.num_threads, 0)
        self.num_envs = num_envs
        self._model = copy.copy(model)
        # Autoreset would return a diverged environment to qpos0 and hide the NaN from the NaN guard
        # and the environment. Both count it, and the environment resets.
        self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        # By default `Batch` uses every core of the machine.
        threads = cfg.num_threads or min(cores_per_process(), num_envs)
        # State before and after the last step.
        size = mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_INTEGRATION))
        self.reserve(2 * 8 * size)
        try:
            self._batch = self._make_batch(self._model, num_envs, threads)
        except (ValueError, RuntimeError) as error:
            if "bad_alloc" in str(error):
                raise MemoryError(f"{num_envs} environments") from error
            raise EngineUnavailableError(
                f"The native engine does not support this model: {error}; use --engine warp."
            ) from error
        self._rows = torch.from_numpy(self._batch.state)
        self._inputs: dict[str, _Input] = {}
        self._outputs: dict[str, _Copy] = {}
        self._tensors: dict[str, torch.Tensor] = {}
        self._model_copies: dict[str, _Input] = {}
        self.model_fields: dict[str, torch.Tensor] = {}
        # (nsensordata,) columns of `sensordata` that a stage computes.
        stages = np.repeat(self._model.sensor_needstage, self._model.sensor_dim)
        self._sensor_columns = {
            name: None if (stages <= value).all() else torch.from_numpy(stages <= value)
            for name, value in STAGES.items()
        }
        self._frame_marks: dict[str, np.ndarray] = {}
        self._bounds: Batch | None = None
        # State before the last `Batch.step`, its number of substeps, and environments with a later
        # `forward` of the velocity stage or the acceleration stage.
        self._before, self._substeps = self._batch.state.copy(), 0
        self._has_velocities = np.ones(num_envs, dtype=bool)
        self._has_accelerations = np.ones(num_envs, dtype=bool)
        self._has_warned = False
        self._disabled = self._batch.expand("opt.disableflags")
        threads = self._batch.nthread
        self._rays = NativeRays(self, self._model, self._batch)
        self._renderer = NativeRenderer(self, self._model, threads, self._make_batch)
        self.capabilities = Capabilities(
            name="native",
            description=(
                f"native (MuJoCo {mujoco.__version__}), device cpu, "
                f"{threads} physics thread{'s' if threads != 1 else ''}"
            ),
            num_threads=threads,
            render_problem=render_problem(self._model),
        )

    # Fields.

    def data_field(self, name: str) -> torch.Tensor:
        if name not in self._tensors:
            if name in ("contact", "nacon", "efc"):
                raise UnknownAttributeError(
                    f"The native engine does not provide sim.data.{name}; use a contact sensor "
                    '(ContactSensorCfg), or --engine warp (cfg.sim.engine = "warp").'
                )
            try:
                source = _as_tensor(self._batch.bind(name))
            except ValueError as error:
                raise UnknownAttributeError(f"The native engine: {error}.") from error
            # Two copies of a view on the rows, or a source and its copy.
            self.reserve((4 + 4 if name in INPUTS else 8 + 4) * source[0].numel())
            is_float, is_bool = source.dtype == torch.float64, name == "eq_active"
            dtype = torch.bool if is_bool else torch.float32 if is_float else source.dtype
            if name in INPUTS:
                field = self._inputs[name] = _Input(source, dtype)
            else:
                field = _Copy(source, dtype)
                self._fill(name, field)
                self._outputs[name] = field
            self._tensors[name] = _like_mujoco(name, field.values)
        return self._tensors[name]

    def _fill(self, name: str, field: _Copy) -> None:
        """Compute a newly bound field as if it had been bound before the last step.

        `Batch` holds zeros in a new field until the next call. Unless a `forward` has computed the
        field since the last step, the step is repeated from the state before it. All other fields
        are unchanged.
        """
        self._copy_in()
        kept = self._batch.state.copy()
        is_late = name in _LATER_FIELDS["vel"] or name == "sensordata"
        current = self._has_accelerations if is_late else self._has_velocities
        if name in _STEP_FIELDS:
            current = np.zeros_like(current)
        if self._substeps and not current.all():
            self._batch.state[:] = self._before
            self._step(self._substeps)
            self._batch.state[:] = kept
            field.copy_out()
        for stage, chosen in (("vel", self._has_velocities), ("acc", current)):
            # Sensors belong to several stages; later stages overwrite earlier ones.
            if chosen.any() and (stage == "acc" or name == "sensordata"):
                rows = torch.from_numpy(np.flatnonzero(chosen))
                self._call(self._batch.forward, rows, stage=STAGES[stage])
                self._batch.state[:] = kept
                field.copy_out(rows, self._sensor_columns[stage] if name == "sensordata" else None)

    def expand(self, fields: tuple[str, ...]) -> None:
        for name in fields:
            if name in self.model_fields:
                continue
            self._check_expandable(name)
            shared = getattr(self._model, name, getattr(self._model.opt, name, None))
            # With two copies in single precision.
            self.reserve(2 * np.asarray(shared, dtype=np.float64).nbytes)
            for mark in _FRAME_MARKS.get(name, ()):
                if mark not in self._frame_marks:
                    self._frame_marks[mark] = self._batch.expand(mark)
                    self._frame_marks[mark][:] = 0
            option = f"opt.{name}"
            values = _as_tensor(self._batch.expand(option if option in MODEL_FIELDS else name))
            if values.dtype == torch.float64:
                self._model_copies[name] = _Input(values, torch.float32)
                values = self._model_copies[name].values
            self.model_fields[name] = _like_mujoco(name, values)

    def _check_expandable(self, name: str) -> None:
        value = getattr(self._model, name, None)
        counts = isinstance(value, np.ndarray) and value.dtype.kind in "iub"
        if (counts and name not in _FREE_INTEGERS) or name in _BOUNDING_VOLUMES:
            raise ValueError(
                f"Model field {name!r} is part of the model's structure and cannot differ between "
                "environments; use several entities, or several tasks."
            )
        # The world body is always simple.
        simple = np.flatnonzero(self._model.body_simple[1:]) + 1
        if name in _INERTIAL_FRAME and simple.size:
            bodies = [
                mujoco.mj_id2name(self._model, mujoco.mjtObj.mjOBJ_BODY, int(i)) or f"#{int(i)}"
                for i in simple
            ]
            raise ValueError(
                f"Model field {name!r} cannot differ between environments, because the compiler "
                f"simplified the inertia of bodies {', '.join(bodies)}; build the Simulation from a "
                "spec (spec=...), or compile these bodies with simple='false'."
            )

    def structure_field(self, name: str) -> torch.Tensor | None:
        is_float = getattr(self._model, name).dtype.kind == "f"
        if not is_float and name not in _FREE_INTEGERS:
            return None
        if name not in MODEL_FIELDS:
            raise WrongStateError(
                f"Model field {name!r} cannot be written on the native engine; change it in the spec "
                "or model that the Simulation is built from, or use --engine warp "
                '(cfg.sim.engine = "warp").'
            )
        rows = _as_tensor(self._batch.expand(name))
        dtype = torch.float32 if is_float else rows.dtype
        self._model_copies[name] = field = _Input(rows, dtype, is_shared=True)
        return field.values

    def hide_geoms(self, absent: torch.Tensor) -> None:
        # Body masks, compiled from these, are at worst too permissive.
        for name in COLLISION_MASKS:
            array = self._batch.expand(name)
            array[absent.numpy()] = 0
            self.model_fields[name] = _as_tensor(array)

    # Physics.

    def step(self, nstep: int, record: tuple[str, ...] = ()) -> dict[str, torch.Tensor]:
        recorded = {}
        for name in record:
            field = self.data_field(name)
            recorded[name] = field.new_empty(nstep, *field.shape)
        if nstep == 0:
            return recorded
        self._copy_in(thorough=True)
        self._has_velocities[:] = self._has_accelerations[:] = False
        self._before[:], self._substeps = self._batch.state, nstep
        rows = self._step_recorded(nstep, recorded) if record else self._step(nstep)
        for field in self._outputs.values():
            field.copy_out(rows)
        for name in self._inputs.keys() & _ADVANCED:
            self._inputs[name].copy_out()
        return recorded

    def _step(self, nstep: int) -> torch.Tensor | None:
        """Step without records; return the same ids as `_call`."""
        rows = None
        for begin in range(0, nstep, _SUBSTEPS_PER_CALL):
            rows = self._call(self._batch.step, rows, nstep=min(nstep - begin, _SUBSTEPS_PER_CALL))
        return rows

    def _step_recorded(self, nstep: int, recorded: dict[str, torch.Tensor]) -> torch.Tensor | None:
        """Step and record the values after every substep; return the same ids as `_call`.

        `Batch.rollout` stops a simulation at a MuJoCo warning. Such simulations, or all if MuJoCo
        raises, are repeated from the start with one substep per call. Results are bit-identical, at
        1.08 times the cost.
        """
        rows = None
        for begin in range(0, nstep, _SUBSTEPS_PER_CALL):
            part = {
                name: values[begin : begin + _SUBSTEPS_PER_CALL]
                for name, values in recorded.items()
            }
            rows = self._record(part, self._batch.state.copy() if begin else self._before)
        return rows

    def _record(self, recorded: dict[str, torch.Tensor], before: np.ndarray) -> torch.Tensor | None:
        """Step from the state `before` as often as `recorded` has rows."""
        nstep = len(next(iter(recorded.values())))
        warnings = self._batch.warning.copy()
        # `time` is a scalar in `MjData`; `Batch` records it as part of the state.
        items = {
            name: mujoco.mjtState.mjSTATE_TIME if name == "time" else name for name in recorded
        }
        again = np.ones(self.num_envs, dtype=bool)
        # Sleep states of trees cannot be restored.
        if not self._batch.persistent:
            with contextlib.suppress(SimulationError):
                values = self._batch.rollout(nstep, record=tuple(items.values()))
                for name, after in recorded.items():
                    value = _as_tensor(values[items[name]]).transpose(0, 1)
                    after.copy_(value.reshape(after.shape))
                again = (self._batch.warning != warnings).reshape(self.num_envs, -1).any(axis=1)
        if not again.any():
            return None
        ids = rows = torch.from_numpy(np.flatnonzero(again))
        self._batch.state[again] = before[again]
        for k in range(nstep):
            rows = self._call(self._batch.step, ids, nstep=1)
            for name, after in recorded.items():
                (self._outputs.get(name) or self._inputs[name]).copy_out(rows)
                after[k, ids] = self._tensors[name][ids]
        again[rows] = False
        return torch.from_numpy(np.flatnonzero(~again))

    def forward(self, env_ids: torch.Tensor | None, stage: Stage = "acc") -> None:
        chosen = slice(None) if env_ids is None else env_ids.numpy()
        if stage != "pos":
            self._has_velocities[chosen] = True
        if stage == "acc":
            self._has_accelerations[chosen] = True
        # Fields without a copy are computed on first read.
        if not self._outputs:
            return
        self._copy_in()
        if stage != "acc":
            self._disabled[:] |= _WITHOUT_CONSTRAINTS
        rows = self._call(self._batch.forward, env_ids, stage=STAGES[stage])
        self._disabled[:] = self._model.opt.disableflags
        if stage == "acc" and "qacc_warmstart" in self._inputs:
            self._inputs["qacc_warmstart"].copy_out(env_ids)
        # Environments share `MjData`: fields that a stage does not compute belong to another one.
        for name in self._outputs.keys() - _LATER_FIELDS[stage]:
            columns = self._sensor_columns[stage] if name == "sensordata" else None
            self._outputs[name].copy_out(rows, columns)

    def bad_substeps(self) -> torch.Tensor:
        # Warnings since the reset: MuJoCo checks every substep.
        warned = self._batch.warning[:, _BAD_STATES, _COUNT].any(axis=1)
        return torch.from_numpy(warned)

    def bad_dof(self, env_idx: int) -> int | None:
        warnings = self._batch.warning[env_idx]
        for kind in (mujoco.mjtWarning.mjWARN_BADQACC, mujoco.mjtWarning.mjWARN_BADQVEL):
            if warnings[int(kind), _COUNT]:
                return int(warnings[int(kind), _INDEX])
        return None

    def look_ahead(self, env_ids: torch.Tensor) -> Any:
        fields = {name: field.values[env_ids] for name, field in self._outputs.items()}
        rows = env_ids.numpy()
        flags = self._has_velocities[rows], self._has_accelerations[rows]
        self.forward(env_ids, "vel")
        return fields, flags

    def look_back(self, env_ids: torch.Tensor, before: Any) -> None:
        fields, (has_velocities, has_accelerations) = before
        for name, values in fields.items():
            self._outputs[name].values[env_ids] = values
        rows = env_ids.numpy()
        self._has_velocities[rows], self._has_accelerations[rows] = (
            has_velocities,
            has_accelerations,
        )

    def reset(self, env_ids: torch.Tensor | None) -> None:
        self._copy_in(with_state=False)
        self._call(self._batch.reset, env_ids, stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        for field in self._inputs.values():
            field.copy_out(env_ids)
        for name in RESULTS_ZERO_ON_RESET & self._outputs.keys():
            self._outputs[name].values[slice(None) if env_ids is None else env_ids] = 0

    def _call(
        self, method: Callable[..., None], env_ids: torch.Tensor | None = None, **options: int
    ) -> torch.Tensor | None:
        """Run a batch method; return the environments in which MuJoCo did not raise (None: all).

        Environments in which MuJoCo raised keep their state and would raise again. So their `qpos`
        and `qvel` are set to NaN, and the environment detects and resets them.
        """
        try:
            method(None if env_ids is None else env_ids.numpy(), **options)
            return env_ids
        except SimulationError as error:
            if not self._has_warned:
                self._has_warned = True
                logger.warning("%s. Diverged environments are set to NaN.", error)
            for name in ("qpos", "qvel"):
                self._batch.bind(name)[error.ids] = np.nan
            ids = np.arange(self.num_envs) if env_ids is None else env_ids.numpy()
            return torch.from_numpy(np.setdiff1d(ids, error.ids))

    def _copy_in(self, thorough: bool = False, with_state: bool = True) -> None:
        """Copy writes to state and model fields since the last call into the batch.

        Model fields are large and rarely written. So only a `thorough` comparison, once per step,
        detects writes that torch does not count: through numpy or `.data`.
        """
        for field in self._inputs.values() if with_state else ():
            field.copy_in()
        moved = None
        for name, field in self._model_copies.items():
            written = field.copy_in() if thorough or field.is_versioned() else None
            if written is not None and name in _BOUNDED:
                rows = written.reshape(self.num_envs, -1).any(axis=1)
                moved = rows if moved is None else moved | rows
        if moved is not None:
            self._fit_bounding_volumes(torch.from_numpy(np.flatnonzero(moved)))

    def _fit_bounding_volumes(self, env_ids: torch.Tensor | None) -> None:
        """Update the midphase bounding boxes, used for collision detection, of modified geoms.

        MuJoCo does this in mj_setConst. That would also replace the constants that only
        `recompute_constants` updates, so a second batch computes the boxes.
        """
        written = self._model_copies.keys() & _BOUNDED
        volumes = {*_BOUNDING_VOLUMES, "geom_rbound"} - self.model_fields.keys()
        if self._model.bvh_aabb.nbytes > _MOST_BOUNDS:
            volumes.remove("bvh_aabb")
            without = int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
            self._model.opt.disableflags |= without
            self._disabled[:] |= without
        if self._bounds is None:
            # States and written fields of the second batch, volumes of both.
            sizes = [getattr(self._model, name).nbytes for name in (*written, *volumes, *volumes)]
            self.reserve(self._batch.state[0].nbytes + sum(sizes))
            self._bounds = self._make_batch(self._model, self.num_envs)
        for name in written:
            self._bounds.expand(name)[:] = self._batch.expand(name)
        self._call(self._bounds.set_const, env_ids)
        # Bounding spheres too, unless expanded: ray casting in MuJoCo 4 uses them.
        for name in volumes:
            self._batch.expand(name)[:] = self._bounds.expand(name)

    def constants_written_by(self, level: int) -> tuple[str, ...]:
        if level == 0:
            return ()
        return tuple(name for name in _DERIVED_CONSTANTS if getattr(self._model, name).size)

    def recompute_constants(self, level: int, env_ids: torch.Tensor | None) -> None:
        # mj_setConst computes both parts; the part that was not requested is unchanged.
        self.expand(self.constants_written_by(level))
        self._copy_in(thorough=True)
        self._call(self._batch.set_const, env_ids)
        # mj_setConst marks coinciding frames, and later writes may separate them.
        for mark in self._frame_marks.values():
            mark[:] = 0
        for name in self.constants_written_by(level):
            if name in self._model_copies:
                self._model_copies[name].copy_out(env_ids)

    # Queries.

    def raycast(self, query: RayQuery) -> RayHits:
        self._copy_in()
        return self._rays.cast(query)

    def render(self, views: tuple[CameraView, ...]) -> list[Images]:
        if self.capabilities.render_problem is not None:
            raise EngineUnavailableError(self.capabilities.render_problem)
        return self._renderer.render(views)

    def _make_batch(
        self, model: mujoco.MjModel, count: int, num_threads: int | None = None
    ) -> Batch:
        """Return `count` simulations of a model."""
        # Sleep needs one `MjData` per simulation. Without sleep that costs memory (0.23 MB per Go1)
        # and saves no time: factor 0.97 to 1.09 on Go1 and G1 with 256 to 4,096 environments.
        sleeps = model.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        return Batch(model, count, num_threads or self._batch.nthread, persistent=bool(sleeps))

    # Copies.

    def copy_to_host(self, env_idx: int, mj_data: mujoco.MjData) -> None:
        self._copy_in()
        self._batch.get_data(env_idx, mj_data)

    def state_dict(self) -> dict[str, Any]:
        self._copy_in(thorough=True)
        raw = {name: field.source for name, field in self._model_copies.items()}
        return {
            "library": "mujoco.batch",
            "state": self._rows.clone(),
            # Bound fields are bound again on load: a field bound within a step would read values
            # one substep newer.
            "bound": sorted(self._tensors),
            # A forward pass does not reproduce these values of the last substep.
            "results": {
                name: field.values.clone()
                for name, field in self._outputs.items()
                if name in ACCELERATION_FIELDS or name == "sensordata"
            },
            "model": {
                name: raw.get(name, value).clone() for name, value in self.model_fields.items()
            },
        }

    def check_state(self, state: dict[str, Any]) -> None:
        if state.get("library") != "mujoco.batch":
            raise ValueError(
                "Saved physics state: expected one of mujoco.batch, got one of the native engine "
                "before mujoco.batch; exact resume is not supported, load only the weights."
            )
        if self._batch.persistent:
            raise ValueError(
                "Saved physics state: expected a model without sleep, got one with sleep. "
                "Sleep states of trees are not saved, so exact resume is not supported; load only the "
                "weights."
            )
        if state["state"].shape != self._rows.shape:
            raise ValueError(
                f"Saved physics state: expected shape {tuple(self._rows.shape)}, got "
                f"{tuple(state['state'].shape)}; use the task and --num-envs of the saved run."
            )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._has_velocities[:] = self._has_accelerations[:] = True
        for name in state["bound"]:
            self.data_field(name)
        self.expand(tuple(state["model"]))
        for name, value in state["model"].items():
            if name in self._model_copies:
                self._model_copies[name].source.copy_(value)
                self._model_copies[name].copy_out()
            else:
                self.model_fields[name].copy_(value)
        if not self._model_copies.keys().isdisjoint(_BOUNDED):
            self._fit_bounding_volumes(None)
        self._rows.copy_(state["state"])
        for field in self._inputs.values():
            field.copy_out()
        self.forward(None, "vel")
        for name, value in state["results"].items():
            self._outputs[name].values.copy_(value)


class _Copy:
    """Copy of an output in the engine interface's dtype."""

    def __init__(self, source: torch.Tensor, dtype: torch.dtype) -> None:
        # A first read may happen under `inference_mode`. Inference tensors do not count writes and
        # cannot be written outside that mode.
        with torch.inference_mode(False):
            self.source = source
            self.values = source.to(dtype, copy=True, memory_format=torch.contiguous_format)

    def copy_out(
        self, rows: torch.Tensor | None = None, columns: torch.Tensor | None = None
    ) -> None:
        """Copy from the source: everything, `rows`, or `columns` (a mask) of a matrix."""
        if columns is not None:
            kept = self.values.clone()
            self.copy_out(rows)
            torch.where(columns, self.values, kept, out=self.values)
        elif rows is None:
            self.values.copy_(self.source)
        else:
            self.values[rows] = self.source[rows].to(self.values.dtype)


class _Input(_Copy):
    """Copy of a state or model field. Only modified elements are copied to the source.

    So unmodified elements keep the double precision of the source. If shared, the copy has the
    shape of one row of the source, and is copied to all rows.
    """

    def __init__(
        self, source: torch.Tensor, dtype: torch.dtype, *, is_shared: bool = False
    ) -> None:
        super().__init__(source[0] if is_shared else source, dtype)
        self.source = source
        with torch.inference_mode(False):
            self._seen = self.values.clone()
        self._version = self.values._version

    def is_versioned(self) -> bool:
        """Return True if torch counted a write since the last copy."""
        return self.values._version != self._version

    def copy_in(self) -> np.ndarray | None:
        """Copy modified elements to the source; return their mask, None if none.

        Uses numpy: a fifth to a half of torch's time here.
        """
        self._version = self.values._version
        # A term may have written a result of its network.
        values, seen = self.values.detach().numpy(), self._seen.numpy()
        if np.array_equal(values, seen):
            return None
        written = values != seen
        np.copyto(self.source.numpy(), values, where=written)
        np.copyto(seen, values)
        return written

    def copy_out(
        self, rows: torch.Tensor | None = None, columns: torch.Tensor | None = None
    ) -> None:
        super().copy_out(rows, columns)
        index = slice(None) if rows is None else rows
        self._seen[index] = self.values[index]
        self._version = self.values._version


def _as_tensor(array: np.ndarray[Any, Any]) -> torch.Tensor:
    """View an array as a tensor, without torch's warning about read-only arrays."""
    if array.dtype == np.uint64:
        # Torch supports few operations on uint64.
        array = array.view(np.int64)
    with torch.inference_mode(False):
        if array.flags.writeable:
            return torch.from_numpy(array)
        # Not in steps: afterwards, Python shows again the warnings that it had shown.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return torch.from_numpy(array)


def _like_mujoco(name: str, tensor: torch.Tensor) -> torch.Tensor:
    """View rotation matrices as (N, ..., 3, 3); return other fields unchanged."""
    with torch.inference_mode(False):
        return tensor.view(*tensor.shape[:-1], 3, 3) if name in ROTATION_MATRICES else tensor
