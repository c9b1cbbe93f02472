"""Native MuJoCo on CPU threads, through `mjbatch`.

The simulations live as double-precision state rows inside `mjbatch.Batch`. What crosses the seam
are float32 copies of the fields that somebody asked for: `mjbatch` copies changed elements in
before each call and every bound field out after it. So a field costs time only once it is read.
"""

from __future__ import annotations

import copy
import difflib
import functools
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import mjbatch
import mujoco
import numpy as np
import torch

from mjlab.sim.engine import ROTATION_MATRICES, Capabilities, Engine, EngineUnavailableError
from mjlab.sim.engines.field_lists import (
    COLLISION_MASKS,
    CONSTANTS_AT_QPOS0,
    FIXED_CONSTANTS,
    INPUTS,
    ZERO_INPUTS,
)
from mjlab.sim.engines.native_first_step import FirstStep
from mjlab.sim.engines.native_midphase import FIELDS as MIDPHASE_FIELDS
from mjlab.sim.engines.native_midphase import MidphaseMargins
from mjlab.sim.engines.native_rays import NativeRays
from mjlab.sim.engines.native_render import NativeRenderer, render_problem
from mjlab.sim.engines.sensor_fed import refuse_without_sensor
from mjlab.utils.processes import cores_per_process

if TYPE_CHECKING:
    from mjlab.sim.config import SimulationCfg
    from mjlab.sim.rendering import CameraView, Images

# State components that physics itself changes: bound from the start, so that `reset` can reach
# them. The others change only by being written, and whoever writes them binds them first.
_ALWAYS_BOUND = ("time", "qpos", "qvel", "act", "qacc_warmstart", "ctrl")
_RESULTS_ZERO_ON_RESET = ("qacc", "act_dot", "sensordata")

# `Batch.set_const` would bind these as double; they are expanded as float32 first, so that they
# can be read through the seam.
_DERIVED_CONSTANTS = (*FIXED_CONSTANTS, *CONSTANTS_AT_QPOS0, "dof_M0")

# The compiler marks frames that coincide and MuJoCo then skips their transforms, so the marks
# have to go before such a frame is randomized.
_FRAME_MARKS = {
    "body_ipos": ("body_sameframe", "geom_sameframe", "site_sameframe"),
    "body_iquat": ("body_sameframe", "geom_sameframe", "site_sameframe"),
    "geom_pos": ("geom_sameframe",),
    "geom_quat": ("geom_sameframe",),
    "site_pos": ("site_sameframe",),
    "site_quat": ("site_sameframe",),
}
_INERTIAL_FRAME = ("body_ipos", "body_iquat")

# Whole numbers in a model are addresses, kinds and masks, from which array sizes and the pairs that
# may collide were compiled; changed in one environment they would act in part or not at all. These
# are the ones that MuJoCo looks up each time and that nothing was compiled from.
_FREE_INTEGERS = frozenset(
    {"geom_matid", "geom_dataid", "geom_condim", "geom_priority", "mat_texid", "mat_texuniform"}
    | {"site_matid", "tendon_matid", "light_active", "light_castshadow", "light_type"}
    | {"jnt_limited", "tendon_limited", "jnt_actfrclimited", "tendon_actfrclimited"}
    | {"actuator_ctrllimited", "actuator_forcelimited", "actuator_actlimited"}
)
_DERIVED_BY_ENGINE = frozenset({"body_margin"})


class NativeEngine(Engine):
    """MuJoCo's own C code, one thread pool for all environments, bit-reproducible."""

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, cfg: SimulationCfg, device: str
    ) -> None:
        if cfg.num_threads < 0:
            raise ValueError(
                f"SimulationCfg.num_threads is {cfg.num_threads}; give 0 for all cores, or more."
            )
        self.num_envs = num_envs
        self._model = copy.copy(model)
        # MuJoCo would put a diverged environment back to qpos0 by itself and hide the NaN from
        # the guard and from the environment, which count it and reset that environment.
        self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        # `mjbatch` would take every core of the machine by itself.
        threads = cfg.num_threads or min(cores_per_process(), num_envs)
        try:
            self._batch = mjbatch.Batch(self._model, num_envs, threads)
        except (ValueError, RuntimeError) as error:
            raise EngineUnavailableError(
                f"The native engine refuses this model: {error}. Use --engine warp."
            ) from error
        self._arrays: dict[str, np.ndarray] = {}
        self._derived: set[str] = set()
        self._first_step = FirstStep(self._batch, self._arrays)
        self._tensors: dict[str, torch.Tensor] = {}
        self._model_arrays: dict[str, np.ndarray] = {}
        self._model_tensors: dict[str, torch.Tensor] = {}
        self._frame_marks: list[np.ndarray] = []
        self._midphase: MidphaseMargins | None = None
        for name in _ALWAYS_BOUND:
            self._bind(name)
        self._qpos0 = torch.from_numpy(self._model.qpos0.astype(np.float32))
        self._eq_active0 = torch.from_numpy(np.array(self._model.eq_active0, dtype=bool))
        self._mocap_body = torch.from_numpy(np.flatnonzero(self._model.body_mocapid >= 0))
        self._warm_start = _state_slice(self._model, mujoco.mjtState.mjSTATE_WARMSTART)
        # Delays of MuJoCo's own actuators and sensors keep a history, which starts out not zero.
        self._history = _state_slice(self._model, mujoco.mjtState.mjSTATE_HISTORY)
        self._history0 = self._batch.bind("state")[0, self._history].copy()
        self._rays: NativeRays | None = None
        self._renderer: NativeRenderer | None = None
        threads = self._batch.num_threads
        self.capabilities = Capabilities(
            name="native",
            device="cpu",
            description=(
                f"native (mjbatch {version('mjbatch')}, MuJoCo {mujoco.__version__}), "
                f"device cpu, {threads} physics thread{'s' if threads != 1 else ''}"
            ),
            num_threads=threads,
            render_problem=render_problem(self._model),
        )
        self._batch.forward()

    # Fields.

    def data_field(self, name: str) -> torch.Tensor:
        if name not in self._tensors:
            refuse_without_sensor(self._model, name)
            tensor = self._bind(name)
            if name in INPUTS:
                self._first_step.input_was_bound(name)
            elif tensor.numel():
                self._fill(name)
        return self._tensors[name]

    def _fill(self, new: str) -> None:
        """Compute a field that was just bound, which reads zero until the next call.

        Only this field is computed: in the middle of the first step from the state one substep
        ago, as in every later step, and else from the current state. The others stay as they
        were, and so does the solver's warm start: when a field is first read changes nothing else.
        """
        others = [name for name in self._derived if name != new]
        saved = {name: self._arrays[name].copy() for name in others}
        if self._first_step.can_repeat:
            self._refresh_midphase()
            self._first_step.repeat_substep()
        else:
            self._forward_keeping_warm_start()
        for name, values in saved.items():
            self._arrays[name][:] = values

    def _forward_keeping_warm_start(self) -> None:
        self._refresh_midphase()
        rows = self._batch.bind("state")
        warm_start = rows[:, self._warm_start].copy()
        self._batch.forward()
        rows[:, self._warm_start] = warm_start

    def _bind(self, name: str) -> torch.Tensor:
        array = _as_float32(self._batch.bind, name, "MjData")
        self._arrays[name] = array
        if name not in INPUTS:
            self._derived.add(name)
        self._tensors[name] = _as_tensor(name, array)
        return self._tensors[name]

    def model_field(self, name: str) -> torch.Tensor:
        if name not in self._model_tensors:
            raise ValueError(f"MjModel field {name!r} has not been expanded.")
        return self._model_tensors[name]

    def is_expanded(self, field: str) -> bool:
        return field in self._model_tensors

    def expand(self, fields: tuple[str, ...]) -> None:
        for name in fields:
            if name in self._model_tensors:
                continue
            self._check_expandable(name)
            for mark in _FRAME_MARKS.get(name, ()):
                if mark not in self._model_arrays:
                    self._model_arrays[mark] = self._batch.expand(mark)
                    self._model_arrays[mark][:] = 0
                    self._frame_marks.append(self._model_arrays[mark])
            array = _as_float32(self._batch.expand, name, "MjModel")
            self._model_arrays[name] = array
            # Whether a tensor made in inference mode was written cannot be seen afterwards.
            with torch.inference_mode(False):
                self._model_tensors[name] = _as_tensor(name, array)
            if name in MIDPHASE_FIELDS and self._midphase is None:
                self._midphase = MidphaseMargins(self._model, self.num_envs, self._batch.expand)

    def _check_expandable(self, name: str) -> None:
        value = getattr(self._model, name, None)
        counts = isinstance(value, np.ndarray) and value.dtype.kind in "iub"
        if (counts and name not in _FREE_INTEGERS) or name in _DERIVED_BY_ENGINE:
            raise ValueError(
                f"Model field {name!r} is part of the model's structure and cannot differ between "
                "environments. Use several entities, or several tasks."
            )
        if name in _INERTIAL_FRAME and self._model.body_simple.any():
            bodies = [
                mujoco.mj_id2name(self._model, mujoco.mjtObj.mjOBJ_BODY, int(i)) or f"#{int(i)}"
                for i in np.flatnonzero(self._model.body_simple)
            ]
            raise ValueError(
                f"Model field {name!r} cannot differ between environments, because the compiler "
                f"simplified the inertia of bodies {', '.join(bodies)}. Build the Simulation from a "
                "spec (spec=...), or compile those bodies with simple='false'."
            )

    def hide_geoms(self, absent: torch.Tensor) -> None:
        # The compiler's own use of these is for bodies as a whole, and a superset does no harm.
        for name in COLLISION_MASKS:
            array = self._batch.expand(name)
            array[absent.numpy()] = 0
            self._model_arrays[name], self._model_tensors[name] = array, _as_tensor(name, array)

    # Physics.

    def step(self, nstep: int) -> None:
        self._refresh_midphase()
        if self._first_step.is_over or nstep < 1:
            self._batch.step(nstep=nstep)
        else:
            self._first_step.step(nstep, self._forward_keeping_warm_start)

    def forward(self, env_ids: torch.Tensor | None) -> None:
        self._first_step.forward()
        # Where nobody reads a derived field there is nothing to make current. One that is read
        # later is computed then.
        if self._derived:
            self._refresh_midphase()
            self._batch.forward(_as_ids(env_ids))

    def _refresh_midphase(self) -> None:
        if self._midphase is not None:
            self._midphase.refresh(self._model_tensors)

    def reset(self, env_ids: torch.Tensor | None) -> None:
        # Written through the bound copies and not with Batch.reset, which would keep writes that
        # are still pending (an action sent to an environment that now starts over) and would
        # recompute derived fields that terms still read.
        rows: Any = slice(None) if env_ids is None else env_ids
        for name in (*ZERO_INPUTS, *_RESULTS_ZERO_ON_RESET):
            if name in self._tensors:
                self._tensors[name][rows] = 0
        qpos0 = self._model_tensors.get("qpos0")
        self._tensors["qpos"][rows] = self._qpos0 if qpos0 is None else qpos0[rows]
        # The warm start goes in the state rows too: a forward pass that must not change it keeps
        # what stands there.
        chosen = slice(None) if env_ids is None else env_ids.numpy()
        self._batch.bind("state")[chosen, self._warm_start] = 0.0
        if self._history0.size:
            self._batch.bind("state")[chosen, self._history] = self._history0
        if "eq_active" in self._tensors:
            self._tensors["eq_active"][rows] = self._eq_active0
        for name, source in (("mocap_pos", "body_pos"), ("mocap_quat", "body_quat")):
            if name in self._tensors:
                self._tensors[name][rows] = self._mocap_default(source, rows)

    def _mocap_default(self, field: str, rows: Any) -> torch.Tensor:
        order = torch.from_numpy(self._model.body_mocapid[self._mocap_body.numpy()]).argsort()
        bodies = self._mocap_body[order]
        if field in self._model_tensors:
            return self._model_tensors[field][rows][:, bodies]
        return torch.from_numpy(getattr(self._model, field)[bodies.numpy()].astype(np.float32))

    def constants_written_by(self, level: int) -> tuple[str, ...]:
        if level == 0:
            return ()
        return tuple(name for name in _DERIVED_CONSTANTS if getattr(self._model, name).size)

    def recompute_constants(self, level: int, env_ids: torch.Tensor | None) -> None:
        # mj_setConst does both parts at once; the part not asked for comes out as it was.
        self.expand(self.constants_written_by(level))
        self._first_step.forget()
        self._batch.set_const(_as_ids(env_ids))
        # It also marks anew which frames coincide now, and these may be moved apart after it.
        for mark in self._frame_marks:
            mark[:] = 0

    # Queries.

    def raycast(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        geom_groups: tuple[int, ...] | None,
        exclude_body_ids: torch.Tensor | None,
        max_distances: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        if self._rays is None:
            self._rays = NativeRays(
                self._model,
                self._batch,
                self._make_batch,
                lambda: (
                    self.data_field("geom_xpos").numpy(),
                    self.data_field("geom_xmat").numpy(),
                ),
            )
        hits = self._rays.cast(
            origins,
            directions,
            geom_groups,
            exclude_body_ids,
            max_distances,
            self._model_tensors,
        )
        return (
            torch.from_numpy(hits.distances),
            torch.from_numpy(hits.normals),
            torch.from_numpy(hits.geoms),
        )

    def render(self, views: tuple[CameraView, ...]) -> list[Images]:
        if self.capabilities.render_problem is not None:
            raise EngineUnavailableError(self.capabilities.render_problem)
        if self._renderer is None:
            self._renderer = NativeRenderer(
                self._model,
                self.num_envs,
                self._batch.num_threads,
                self._make_batch,
                self.data_field,
                self._model_tensors,
            )
        return self._renderer.render(views)

    def _make_batch(
        self, model: mujoco.MjModel, count: int, num_threads: int | None = None
    ) -> mjbatch.Batch:
        """Make simulations of another model, for what is asked of this one."""
        return mjbatch.Batch(model, count, num_threads or self._batch.num_threads)

    def jacobian(
        self, points: torch.Tensor, body_ids: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        # Not mjbatch's own, which belongs to the present qpos: in the middle of a step that is one
        # substep newer than the positions that the points come from.
        axes, com = self.data_field("cdof"), self.data_field("subtree_com")
        body_ids = body_ids.long()
        moves = self._moving_dofs[body_ids][..., None]
        rows = torch.arange(self.num_envs)
        arm = points - com[rows, self._tree_roots[body_ids]]
        rotational = axes[..., :3] * moves
        translational = axes[..., 3:] * moves
        translational += torch.linalg.cross(rotational, arm[:, None].expand_as(rotational))
        return translational.mT, rotational.mT

    @functools.cached_property
    def _moving_dofs(self) -> torch.Tensor:
        """(nbody, nv) whether a body moves with a degree of freedom."""
        moves = np.zeros((self._model.nbody, self._model.nv), dtype=np.float32)
        for body in range(1, self._model.nbody):
            moves[body] = moves[self._model.body_parentid[body]]
            first = self._model.body_dofadr[body]
            moves[body, first : first + self._model.body_dofnum[body]] = 1.0
        return torch.from_numpy(moves)

    @functools.cached_property
    def _tree_roots(self) -> torch.Tensor:
        """(nbody,) the body at the top of each body's tree, whose centre of mass `cdof` is about."""
        return torch.from_numpy(self._model.body_rootid.astype(np.int64))

    # Copies.

    def copy_to_host(self, env_idx: int, mj_data: mujoco.MjData) -> None:
        state = self._batch.bind("state")[env_idx]
        mujoco.mj_setState(self._model, mj_data, state, int(mujoco.mjtState.mjSTATE_INTEGRATION))
        # Values written since the last call are not in the state row yet.
        for name in self._arrays.keys() & INPUTS:
            value = self._arrays[name][env_idx]
            if name == "time":
                mj_data.time = float(value)
            else:
                getattr(mj_data, name)[:] = value

    def state_dict(self) -> dict[str, Any]:
        # A call consumes the writes that are still pending, so that the rows hold everything; and
        # saving must not change how the run goes on.
        self._first_step.forget()
        self._forward_keeping_warm_start()
        return {
            "state": torch.from_numpy(self._batch.bind("state").copy()),
            "bound": sorted(self._arrays),
            "model": {name: value.clone() for name, value in self._model_tensors.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        rows = self._batch.bind("state")
        saved = state["state"].numpy()
        if saved.shape != rows.shape:
            raise ValueError(
                f"The saved simulation has {saved.shape[0]} environments with {saved.shape[1]} "
                f"state values each; this one has {rows.shape[0]} with {rows.shape[1]}."
            )
        self._first_step.forget()
        # A call consumes the writes that are still pending here, so that none lands on the rows.
        self._batch.forward()
        # Fields that were bound are bound again, because a field that is bound in the middle of
        # a step reads values that are one substep newer than they would have been.
        for name in state["bound"]:
            if name not in self._tensors:
                self._bind(name)
        self.expand(tuple(state["model"]))
        for name, value in state["model"].items():
            self._model_tensors[name].copy_(value)
        self._refresh_midphase()
        rows[:] = saved
        self._batch.forward()
        # The forward pass has set the solver's warm start anew; put back the saved one.
        rows[:] = saved


def _as_float32(request: Any, name: str, struct: str) -> np.ndarray[Any, Any]:
    """Bind or expand a field as float32 where it is real, and as its own type where it is not."""
    owner = mujoco.MjData if struct == "MjData" else mujoco.MjModel
    if name.startswith("_"):
        raise AttributeError(f"{struct} has no field {name!r}.")
    try:
        return request(name, np.float32)
    except (TypeError, ValueError, RuntimeError) as error:
        try:
            return request(name)
        except (TypeError, ValueError, RuntimeError):
            known = [field for field in dir(owner) if not field.startswith("_")]
            close = difflib.get_close_matches(name, known, n=3)
            hint = f" Close names: {', '.join(close)}." if close else ""
            kind = AttributeError if struct == "MjData" else ValueError
            raise kind(
                f"The native engine has no per-environment {struct} field {name!r} ({error}).{hint}"
            ) from error


def _as_tensor(name: str, array: np.ndarray[Any, Any]) -> torch.Tensor:
    """View rotation matrices as (N, ..., 3, 3), and every other field as it is."""
    # A field may be read for the first time under `inference_mode`, whose tensors count no writes.
    with torch.inference_mode(False):
        tensor = torch.from_numpy(array)
        return tensor.view(*array.shape[:-1], 3, 3) if name in ROTATION_MATRICES else tensor


def _state_slice(model: mujoco.MjModel, component: mujoco.mjtState) -> slice:
    """Return where a component stands in an integration state, whose order is that of the bits."""
    before = int(mujoco.mjtState.mjSTATE_INTEGRATION) & (int(component) - 1)
    start = mujoco.mj_stateSize(model, before)
    return slice(start, start + mujoco.mj_stateSize(model, int(component)))


def _as_ids(env_ids: torch.Tensor | None) -> np.ndarray[Any, Any] | None:
    return None if env_ids is None else np.ascontiguousarray(env_ids.numpy())
