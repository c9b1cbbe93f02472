"""Warp engine: all environments in one batch of GPU kernels (on the CPU for testing).

Fields are Warp arrays viewed as torch tensors, without copies. A substep and each stage of the
forward pass are captured as graphs and replayed, on the CPU and on CUDA. A step never waits for the
GPU.

The first use on a machine compiles the kernels (minutes); later uses load them from Warp's cache.
"""

from __future__ import annotations

import dataclasses
import functools
import gc
import logging
import math
import os
from collections.abc import Callable, Generator, Hashable, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import mujoco
import mujoco_warp as mjwarp
import numpy as np
import torch
import warp as wp

from mjlab.sim.engine import (
    ACCELERATION_FIELDS,
    COLLISION_MASKS,
    CONSTANTS_AT_QPOS0,
    FIXED_CONSTANTS,
    INPUTS,
    RESULTS_ZERO_ON_RESET,
    STAGES,
    ZERO_INPUTS,
    Capabilities,
    Engine,
    EngineUnavailableError,
    Stage,
    is_bad,
)
from mjlab.sim.warp.overflow import OverflowWatch
from mjlab.sim.warp.rays import WarpRays
from mjlab.sim.warp.render import WarpRenderer
from mjlab.utils.errors import UnknownAttributeError
from mjlab.utils.memory import check_memory
from mjlab.utils.mujoco import flag_names
from mjlab.utils.string import name_list

if TYPE_CHECKING:
    from mjlab.sim.config import SimulationCfg
    from mjlab.sim.engine import CameraView, Images, RayHits, RayQuery

logger = logging.getLogger(__name__)

# Inputs of the next step: set by `reset`, saved in `state_dict`.
_STATE_FIELDS = (*INPUTS, "history", "tree_asleep")
# Fields with a different layout than in MuJoCo, or without environment dimension.
_UNLIKE_MUJOCO = frozenset(
    {"qLD", "qLDiagInv", "qLU", "solver_niter", "contact", "efc", "flexedge_hessian"}
    | {f"island_{name}" for name in ("dofadr", "idofadr", "iefcadr", "ne", "nf", "nefc", "nv")}
    | {"map_efc2iefc", "map_iefc2efc"}
)
# Fields that MuJoCo Warp overwrites in a stage in addition to its results: delay buffers, to be
# advanced by substeps only; forces of the last substep, used as scratch; velocities read by
# constraints.
_OVERWRITTEN = {
    "pos": ("history", "cvel", "cdof_dot"),
    "vel": ("history", "cacc", "cfrc_int"),
    "acc": ("history",),
}
# Results that MuJoCo's reset also clears. Poses and velocities keep their values until `forward`.
_RESULTS_ZERO_ON_RESET = (*RESULTS_ZERO_ON_RESET, "energy", "ne", "nf", "nl", "nefc")
# Distance of hidden bounds from the rest of the world (m).
_FAR_AWAY = 1e6
# Bounds derived from `geom_size`; recomputed only if expanded or if sizes are.
_GEOM_BOUNDS = ("geom_rbound", "geom_aabb")
_NO_RAYS = (
    "MuJoCo Warp cannot cast rays in a model with flexes; remove the ray sensors or the flexes, or "
    "use --engine native (SimulationCfg.engine='native')."
)
# Fields that determine the poses of geoms welded to the world.
_STATIC_POSE = frozenset({"body_pos", "body_quat", "geom_pos", "geom_quat"})

# Created once per stream.
_as_warp_stream = functools.cache(wp.stream_from_torch)

_RECOMPUTE = {1: mjwarp.set_const_fixed, 2: mjwarp.set_const_0, 3: mjwarp.set_const}


class UnsupportedByWarpError(EngineUnavailableError, NotImplementedError):
    """Model or option that MuJoCo Warp does not support."""


class WarpEngine(Engine):
    """MuJoCo Warp on one CUDA device, or on the CPU.

    `wp_model`, `wp_data` and `wp_device` are MuJoCo Warp's objects.
    """

    # Tensors created here are written later, in any torch mode.
    @torch.inference_mode(False)
    def __init__(
        self, model: mujoco.MjModel, num_envs: int, cfg: SimulationCfg, device: str
    ) -> None:
        """Allocate `num_envs` environments at `qpos0`, after a forward pass.

        Raises:
            UnsupportedByWarpError: MuJoCo Warp does not support the model.
            EngineUnavailableError: device not found.
        """
        check_supported(model)
        self.num_envs = num_envs
        self.device = torch.device(device)
        self.wp_device = find_device(self.device)
        self.mj_model = model
        self._host = mujoco.MjData(model)
        mujoco.mj_forward(model, self._host)
        self._velocity_constraints = bool(
            np.isin(model.eq_type, (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)).any()
        )
        # Zero in MuJoCo; Warp substitutes nonzero values when recomputing constants.
        self._zero_invweight0 = torch.as_tensor(model.body_invweight0 == 0, device=device)
        with self.ordered():
            self._allocate(model, cfg)
            self._unwelded = wp.ones_like(self.wp_model.body_weldid)
        cfg.apply_wp_opt(self.wp_model.opt)
        self._data_tensors: dict[str, torch.Tensor] = {}
        self.model_fields: dict[str, torch.Tensor] = {}
        self._graphs: dict[Hashable, Any] = {}
        self._captures = True
        self._absent: torch.Tensor | None = None
        self._rays = WarpRays(model, self.wp_model, self.wp_data, self.launch)
        self.renderer = WarpRenderer(
            model, self.wp_model, self.wp_data, self.model_fields, self.ordered, self.launch
        )
        # Columns of `sensordata` by the stage that computes them.
        stages = np.repeat(model.sensor_needstage, model.sensor_dim)
        self._sensor_stages = torch.as_tensor(stages, device=self.device)
        # Always bound, because `forward` must preserve these.
        forces = ("cacc", "cfrc_int") if self.wp_model.sensor_rne_postconstraint else ()
        for name in ("sensordata", "history", *forces):
            self.data_field(name)
        # Capacities: constraint rows and contacts per environment, matches per sensor.
        sizes = self.wp_data.njmax, self.wp_data.naconmax // num_envs, cfg.contact_sensor_maxmatch
        self._overflow = OverflowWatch(as_torch(self.wp_data.overflow), sizes, self.measure_sizes)
        self.capabilities = Capabilities(
            name="warp",
            description=(
                f"warp (mujoco_warp {mjwarp.__version__}, Warp {wp.config.version}), "
                f"device {device}" + ("" if self._on_cuda else ", for testing: slow")
            ),
            raycast_problem=_NO_RAYS if model.nflex else None,
        )
        self.create_graph()

    def _allocate(self, model: mujoco.MjModel, cfg: SimulationCfg) -> None:
        # At `qpos0` all robots are at the world origin, possibly deep inside generated terrain.
        # Episodes do not start at `qpos0`, so its contacts say nothing about the required sizes.
        if cfg.nconmax is not None and self._host.ncon > cfg.nconmax:
            logger.warning(
                "The reference pose has %d contacts, more than SimulationCfg.nconmax=%d; its contacts "
                "are ignored until the first reset. If later poses have as many, increase nconmax.",
                self._host.ncon, cfg.nconmax,
            )  # fmt: skip
            flags = model.opt.disableflags
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
            mujoco.mj_forward(model, self._host)
            model.opt.disableflags = flags
        sizes = {"nconmax": cfg.nconmax, "njmax": cfg.njmax}
        # Minimum bytes of a contact and of a constraint row. All arrays are measured below, in one
        # environment.
        for (name, size), least in zip(sizes.items(), (64, 32), strict=True):
            count = (size or 0) * self.num_envs
            name = f"SimulationCfg {name} times num_envs"
            check_memory(name, count, least, str(self.device), "a smaller one", warns=False)
        try:
            self.wp_model = mjwarp.put_model(model)
            one = mjwarp.put_data(model, self._host, 1, **sizes)
        except NotImplementedError as error:
            raise UnsupportedByWarpError(
                f"The warp engine does not support this model: {error} "
                "Change the model, or use --engine native (SimulationCfg.engine='native')."
            ) from error
        except ValueError as error:
            raise ValueError(
                f"MuJoCo Warp rejects nconmax={cfg.nconmax}, njmax={cfg.njmax} or the model: "
                f"{error}; change SimulationCfg.nconmax or njmax (None: estimated)."
            ) from error
        self.reserve(sum(array.capacity for array in _arrays(one)), str(self.device))
        self.wp_data = mjwarp.put_data(model, self._host, self.num_envs, **sizes)
        # Kernels would print to stdout at every overflow. Instead, `OverflowWatch` polls the
        # overflow flags and logs each kind once.
        self.wp_model.opt.warn_overflow = 0
        if self._on_cuda:
            self.wp_model.opt.graph_conditional = wp.is_conditional_graph_supported()

    # Order of work on the GPU.

    @property
    def _on_cuda(self) -> bool:
        return self.wp_device.is_cuda

    @contextmanager
    def ordered(self) -> Generator[None]:
        """Order Warp's work after torch's queued work and before torch's later work.

        Warp uses a separate stream, because it frees memory in that stream's order, and because
        captures are not allowed on torch's default stream. The two streams
        wait for each other on the device; the host waits for neither.
        """
        with wp.ScopedDevice(self.wp_device):
            if not self._on_cuda:
                yield
                return
            torch_stream = _as_warp_stream(torch.cuda.current_stream(self.device))
            self.wp_device.stream.wait_stream(torch_stream)
            yield
            torch_stream.wait_stream(self.wp_device.stream)

    def launch(
        self, name: Hashable, work: Callable[[], None], times: int = 1, on_cpu: bool = True
    ) -> None:
        """Run `work` `times` times by replaying its graph.

        On CUDA the first run is not captured: it loads the kernels, because older drivers cannot
        load them during a capture. `on_cpu=False` disables graphs on the CPU, for work that CPU
        captures do not record: filling arrays and refitting bounding volume hierarchies.
        """
        with self.ordered():
            if name not in self._graphs:
                if self._on_cuda:
                    work()
                    times -= 1
                is_captured = self._captures and (self._on_cuda or on_cpu)
                self._graphs[name] = self._capture(work) if is_captured else None
            graph = self._graphs[name]
            for _ in range(times):
                work() if graph is None else wp.capture_launch(graph)

    def _capture(self, work: Callable[[], None]) -> Any:
        """Return the graph of `work`, or None if capturing is not supported."""
        collects = gc.isenabled()
        # Garbage collection may free GPU memory, which breaks a capture.
        gc.disable()
        try:
            with wp.ScopedCapture(device=self.wp_device) as capture:
                work()
            return capture.graph
        except RuntimeError as error:
            self._captures = False
            logger.warning(
                "Warp graph capture failed; launching kernels one by one is slower: %s",
                error,
            )  # fmt: skip
            return None
        finally:
            if collects:
                gc.enable()

    @torch.inference_mode(False)
    def create_graph(self) -> None:
        """Drop captured graphs. On CUDA, recapture those of `step` and `forward` immediately.

        On the CPU, and after `expand`, graphs are captured at the next use. State and results keep
        their values. Overflow during warm-up is not reported.
        """
        self._graphs.clear()
        if not self._on_cuda:
            return
        with _restoring([(as_torch(array), None) for array in _arrays(self.wp_data)]):
            self.launch("step", self._substep)
            for stage in STAGES:
                self.launch(stage, lambda stage=stage: self._forward(stage))

    # Fields.

    @torch.inference_mode(False)
    def data_field(self, name: str) -> Any:
        if name in ("contact", "efc"):
            values = vars(getattr(self.wp_data, name)).items()
            return SimpleNamespace(**{key: _readable(value) for key, value in values})
        if name not in self._data_tensors:
            offered = offered_data_fields(self.wp_data)
            if name not in offered and hasattr(self.wp_data, name):
                return _readable(getattr(self.wp_data, name))
            if name == "ncon" or name.startswith("efc_"):
                raise UnknownAttributeError(
                    f"The warp engine does not provide MjData.{name}; use a contact sensor, or "
                    "sim.data.nacon and sim.data.contact for the contacts of all environments "
                    "together."
                )
            if name not in offered:
                raise UnknownAttributeError(
                    f"Unknown per-environment MjData field {name!r} of the warp engine. Available: "
                    f"{name_list(sorted(offered), near=(name,))}."
                )
            self._data_tensors[name] = as_torch(getattr(self.wp_data, name))
        return self._data_tensors[name]

    @torch.inference_mode(False)
    def expand(self, fields: tuple[str, ...]) -> None:
        new = [name for name in dict.fromkeys(fields) if name not in self.model_fields]
        for name in new:
            shared = getattr(*find_model_field(self.wp_model, name))
            size = math.prod(shared.shape[1:]) * wp.types.type_size_in_bytes(shared.dtype)
            self.reserve(size, str(self.device))
        with self.ordered():
            arrays = expand_arrays(self.wp_model, self.num_envs, new)
        for name, array in zip(new, arrays, strict=True):
            tensor = as_torch(array)
            # MuJoCo stores centers and half sizes in one row.
            self.model_fields[name] = tensor.flatten(-2) if name == "geom_aabb" else tensor
        # Graphs hold the addresses of the arrays they were captured with.
        if new and self.num_envs > 1:
            self._graphs.clear()

    def structure_field(self, name: str) -> torch.Tensor | None:
        array = getattr(self.wp_model, name, None)
        # MuJoCo Warp compiles collision pairs from the masks.
        is_live = isinstance(array, wp.array) and name not in COLLISION_MASKS
        return as_torch(array) if is_live else None

    @torch.inference_mode(False)
    def hide_geoms(self, absent: torch.Tensor) -> None:
        self.expand(_GEOM_BOUNDS)
        hide_geoms(self.wp_model, absent)
        self._absent = absent
        # For readers of these fields: Warp itself shares the masks between environments.
        for name in COLLISION_MASKS:
            mask = torch.as_tensor(getattr(self.mj_model, name), device=self.device)
            self.model_fields[name] = mask.expand(absent.shape).masked_fill(absent, 0)

    def constants_written_by(self, level: int) -> tuple[str, ...]:
        names: tuple[str, ...] = ()
        if level in (1, 3):
            names += FIXED_CONSTANTS
            if not self.model_fields.keys().isdisjoint(("geom_size", *_GEOM_BOUNDS)):
                names += _GEOM_BOUNDS
        if level in (2, 3):
            names += CONSTANTS_AT_QPOS0
        return tuple(name for name in names if getattr(self.wp_model, name).size)

    def recompute_constants(self, level: int, env_ids: torch.Tensor | None) -> None:
        written = self.constants_written_by(level)
        self.expand(written)
        others = self._rows_except(env_ids)
        kept = [(self.model_fields[name], others) for name in written if others is not None]
        with _restoring(kept):
            with self.ordered():
                _RECOMPUTE[level](self.wp_model, self.wp_data)
            if "body_invweight0" in written:
                # Bodies that only slide have zero rotational inverse weight, and bodies that only
                # rotate about their center of mass zero translational inverse weight. Warp
                # substitutes the other weight.
                weights = as_torch(self.wp_model.body_invweight0)
                substituted = (weights[..., :1] == weights[..., 1:]) & self._zero_invweight0
                weights.masked_fill_(substituted, 0.0)
            # Recomputed bounds make hidden geoms collide, so hide them again.
            if self._absent is not None and "geom_rbound" in written:
                hide_geoms(self.wp_model, self._absent)

    def _rows_except(self, env_ids: torch.Tensor | None) -> torch.Tensor | None:
        """Return a mask of environments not in `env_ids`, (N,) bool; None if `env_ids` is None."""
        if env_ids is None:
            return None
        mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        return mask.index_fill_(0, env_ids, False)

    # Physics.

    def step(self, nstep: int, record: tuple[str, ...] = ()) -> dict[str, torch.Tensor]:
        fields = {name: self.data_field(name) for name in record}
        recorded = {name: field.new_empty(nstep, *field.shape) for name, field in fields.items()}
        launches = nstep if record else 1
        for k in range(launches):
            self.launch("step", self._substep, nstep // launches)
            for name, field in fields.items():
                recorded[name][k] = field
        self._overflow.tick()
        return recorded

    def bad_substeps(self) -> torch.Tensor:
        return is_bad(self.data_field("qacc"))

    def bad_dof(self, env_idx: int) -> int | None:
        bad = ~(self.data_field("qacc")[env_idx].abs() <= mujoco.mjMAXVAL)
        return int(bad.to(torch.int32).argmax()) if bool(bad.any()) else None

    def _substep(self) -> None:
        self._refresh_velocities()
        mjwarp.step(self.wp_model, self.wp_data)

    def _refresh_velocities(self) -> None:
        """Compute `cvel` before constraints that read it.

        Connect and weld constraints use body velocities, but Warp computes `cvel` after them.
        Constraints would use velocities of the previous substep and, after a reset, of the previous
        episode, NaN included.
        """
        if self._velocity_constraints:
            mjwarp.fwd_kinematics(self.wp_model, self.wp_data)
            mjwarp.com_vel(self.wp_model, self.wp_data)

    def forward(self, env_ids: torch.Tensor | None, stage: Stage = "acc") -> None:
        """Compute stages up to `stage`; other environments keep their results.

        Warp computes all environments and uses fields of later stages as scratch. These fields are
        restored: values that are one substep old stay so, as on native.
        """
        others = self._rows_except(env_ids)
        kept: list[tuple[torch.Tensor, torch.Tensor | None]] = []
        for name, tensor in self._data_tensors.items():
            if name == "sensordata":
                mask = (self._sensor_stages > STAGES[stage])[None]
                kept.append((tensor, mask if others is None else mask | others[:, None]))
            elif name in _OVERWRITTEN[stage]:
                kept.append((tensor, None))
            elif others is not None and name not in _STATE_FIELDS:
                kept.append((tensor, others))
        with _restoring(kept):
            if not _STATIC_POSE.isdisjoint(self.model_fields):
                self.launch("kinematics", self._place_static_geoms)
            self.launch(stage, lambda: self._forward(stage))

    def _forward(self, stage: str) -> None:
        """Compute stages up to `stage` in all environments; overwrites fields of later stages."""
        model, data = self.wp_model, self.wp_data
        self._refresh_velocities()
        if stage == "acc":
            mjwarp.forward(model, data)
            return
        mjwarp.fwd_position(model, data, factorize=False)
        # Sensors without a measurement, such as inactive limits, do not write their value.
        data.sensordata.zero_()
        mjwarp.sensor_pos(model, data)
        has_energy = model.opt.enableflags & mjwarp.EnableBit.ENERGY
        if has_energy:
            mjwarp.energy_pos(model, data)
        if stage == "vel":
            mjwarp.fwd_velocity(model, data)
            mjwarp.sensor_vel(model, data)
            if has_energy:
                mjwarp.energy_vel(model, data)

    def _place_static_geoms(self) -> None:
        """Compute the poses of geoms welded to the world. Warp itself computes them only once."""
        unwelded = dataclasses.replace(self.wp_model, body_weldid=self._unwelded)
        mjwarp.kinematics(unwelded, self.wp_data)

    def look_ahead(self, env_ids: torch.Tensor) -> Any:
        fields = {
            name: tensor.clone()
            for name, tensor in self._data_tensors.items()
            if name not in _STATE_FIELDS
        }
        # A pass computes all environments anyway, and `look_back` restores all.
        self.forward(None, "vel")
        return fields

    def look_back(self, env_ids: torch.Tensor, before: Any) -> None:
        for name, values in before.items():
            self._data_tensors[name].copy_(values)

    def reset(self, env_ids: torch.Tensor | None) -> None:
        # `mjwarp.reset_data` clears the contacts of all environments with those of the first, and
        # overflow flags before they are read. So fields are reset one by one.
        cleared = dict.fromkeys((*ZERO_INPUTS, *_RESULTS_ZERO_ON_RESET), 0)
        # Awake for as long as possible.
        cleared["tree_asleep"] = -(1 + mujoco.mjMINAWAKE)
        for name, value in cleared.items():
            tensor = self.data_field(name)
            # `tensor[env_ids] = value` waits for a GPU (seen on an H200 with torch 2.11).
            tensor.fill_(value) if env_ids is None else tensor.index_fill_(0, env_ids, value)
        rows = slice(None) if env_ids is None else env_ids
        model = self.wp_model
        mocap = as_torch(model.mocap_bodyid).long()
        starts = {
            "qpos": as_torch(model.qpos0),
            "eq_active": as_torch(model.eq_active0)[None],
            "mocap_pos": as_torch(model.body_pos)[:, mocap],
            "mocap_quat": as_torch(model.body_quat)[:, mocap],
        }
        for name, values in starts.items():
            tensor = self.data_field(name)
            tensor[rows] = values.expand(tensor.shape)[rows]
        if self.mj_model.nhistory:
            others = self._rows_except(env_ids)
            mask = None if others is None else wp.from_torch(~others)
            with self.ordered():
                mjwarp.reset_history(self.wp_model, self.wp_data, reset=mask)

    def measure_sizes(self) -> torch.Tensor:
        """Return the current requirement of each of `SIZES`, (3,).

        The matches of a sensor are bounded by the contacts of its environment.
        """
        data = self.wp_data
        rows, contacts = as_torch(data.nefc).amax(), as_torch(data.nacon)
        pooled = torch.maximum(contacts, as_torch(data.ncollision))[0]
        environments = as_torch(data.contact.worldid)
        exists = torch.arange(len(environments), device=self.device) < contacts
        totals = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        totals.scatter_add_(0, environments.clamp(0, self.num_envs - 1).long(), exists.long())
        # Contacts are pooled, so only their mean (rounded up) must fit.
        return torch.stack([rows, -(-pooled // self.num_envs), totals.amax()])

    def close(self) -> None:
        """Log exceeded capacities, once per kind. Waits for the GPU."""
        self._overflow.check(wait=True)

    # Queries.

    def raycast(self, query: RayQuery) -> RayHits:
        if self.capabilities.raycast_problem is not None:
            raise UnsupportedByWarpError(self.capabilities.raycast_problem)
        return self._rays.cast(query)

    def render(self, views: tuple[CameraView, ...]) -> list[Images]:
        return self.renderer.render(views)

    # Copies.

    def copy_to_host(self, env_idx: int, mj_data: mujoco.MjData) -> None:
        for name in _STATE_FIELDS:
            setattr(mj_data, name, self.data_field(name)[env_idx].cpu().numpy())

    def state_dict(self) -> dict[str, Any]:
        tensors = {
            "data": {name: self.data_field(name) for name in _STATE_FIELDS},
            # A forward pass does not reproduce these values of the last substep.
            "results": self._last_results(),
            "model": self.model_fields,
        }
        return {
            kind: {name: tensor.cpu().clone() for name, tensor in fields.items()}
            for kind, fields in tensors.items()
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name, value in state["data"].items():
            if value.shape != self.data_field(name).shape:
                raise ValueError(
                    f"Saved physics state {name}: expected shape "
                    f"{tuple(self.data_field(name).shape)}, got {tuple(value.shape)}; use the model "
                    "and --num-envs of the saved run."
                )
        self.expand(tuple(state["model"]))
        for name, value in state["model"].items():
            self.model_fields[name].copy_(value)
        for name, value in state["data"].items():
            self.data_field(name).copy_(value)
        # Earlier releases saved no results, or only the fields that were read.
        results = state.get("results", {})
        self.forward(None, "vel" if results else "acc")
        for name, tensor in self._last_results().items():
            if name in results:
                tensor.copy_(results[name])

    def _last_results(self) -> dict[str, torch.Tensor]:
        """Return all results of the acceleration stage and all sensors, including unread fields."""
        names = sorted(offered_data_fields(self.wp_data) & (ACCELERATION_FIELDS | {"sensordata"}))
        return {name: as_torch(getattr(self.wp_data, name)) for name in names}


def check_supported(model: mujoco.MjModel) -> None:
    """Check that MuJoCo Warp supports the options and actuators of a model.

    Raises:
        UnsupportedByWarpError: lists everything unsupported, with alternatives.
    """
    problems = []
    if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
        problems.append("the solver 'pgs'; use MujocoCfg.solver='newton' or 'cg'")
    for element, kind, instead in (
        ("pid", mujoco.mjtGain.mjGAIN_PID, "<position> or BuiltinPdActuatorCfg"),
        ("orientation", mujoco.mjtGain.mjGAIN_SO3, "one <position> for each hinge"),
    ):
        ids = np.flatnonzero(model.actuator_gaintype == kind)
        if len(ids):
            names = [model.actuator(i).name or f"(id {i})" for i in ids]
            problems.append(f"the <{element}> actuators {names}; use {instead} instead")
    for kind, known in (("disable", mjwarp.DisableBit), ("enable", mjwarp.EnableBit)):
        option = f"{kind}flags"
        supported = sum(int(bit) for bit in known)
        problems += [
            f"the {kind} flag {flag!r}; leave it out of MujocoCfg.{option} and of the XML"
            for flag in flag_names(option, getattr(model.opt, option) & ~supported)
        ]
    if problems:
        raise UnsupportedByWarpError(
            "The warp engine does not support this model:\n"
            + "\n".join(f"  - {problem}" for problem in problems)
            + "\nOr use --engine native (SimulationCfg.engine='native'), which supports all of it."
        )


@contextmanager
def _restoring(kept: Sequence[tuple[torch.Tensor, torch.Tensor | None]]) -> Generator[None]:
    """Restore tensors on exit, where a mask over the first dimensions is True (None: all)."""
    before = [tensor.clone() for tensor, _ in kept]
    yield
    for (tensor, mask), old in zip(kept, before, strict=True):
        if mask is not None:
            mask = mask.view(*mask.shape, *[1] * (tensor.dim() - mask.dim()))
            old = torch.where(mask, old, tensor)
        tensor.copy_(old)


# Warp structs.


@torch.inference_mode(False)
def as_torch(array: Any) -> torch.Tensor:
    """View a Warp array as a torch tensor with shared memory; vectors become last dimensions."""
    if array.size == 0:
        inner = getattr(array.dtype, "_shape_", ())
        scalar = wp.dtype_to_torch(getattr(array.dtype, "_wp_scalar_type_", array.dtype))
        device = wp.device_to_torch(array.device)
        return torch.empty((*array.shape, *inner), dtype=scalar, device=device)
    return wp.to_torch(array)


def _readable(value: Any) -> Any:
    """View a Warp array as a torch tensor; return other values unchanged."""
    return as_torch(value) if isinstance(value, wp.array) else value


def offered_data_fields(data: Any) -> set[str]:
    """Return the names of the per-environment `MjData` fields."""
    fields = _fields_over(type(data), "nworld") - _UNLIKE_MUJOCO
    return {name for name in fields if hasattr(mujoco.MjData, name)}


def find_model_field(model: Any, name: str) -> tuple[Any, str]:
    """Return the struct (model or its options) and attribute name of a model field.

    Options are named `<name>` or `opt.<name>`.

    Raises:
        ValueError: unknown field, or one that cannot differ between environments.
    """
    attribute = name.removeprefix("opt.")
    for struct in (model, model.opt):
        if attribute in _fields_over(type(struct), "*"):
            return struct, attribute
    if hasattr(mujoco.MjModel, attribute) or hasattr(mujoco.MjOption, attribute):
        raise ValueError(
            f"MuJoCo Warp shares model field {name!r} between all environments; set it in the model "
            "before building the simulation, or use --engine native."
        )
    known = sorted(_fields_over(type(model), "*"))
    raise ValueError(
        f"Unknown MjModel field {name!r}. Available: {name_list(known, near=(name,))}."
    )


def _fields_over(struct: type[Any], dimension: str) -> set[str]:
    """Return the names of array fields with first dimension `dimension`."""
    return {
        field.name
        for field in dataclasses.fields(struct)
        if (getattr(field.type, "shape", None) or (None,))[0] == dimension
    }


def _arrays(data: Any) -> list[wp.array]:
    """Return all arrays of a `mujoco_warp.Data`."""
    values = [a for part in (data, data.contact, data.efc) for a in vars(part).values()]
    return [value for value in values if isinstance(value, wp.array)]


def expand_arrays(model: Any, nworld: int, names: list[str]) -> list[Any]:
    """Expand fields of a `mujoco_warp.Model` to one row per world, in place.

    Returns:
        Arrays of the fields.

    Raises:
        ValueError: unknown field, or one that MuJoCo Warp cannot hold per world.
    """
    found = [find_model_field(model, name) for name in names]
    for struct, attribute in found:
        shared = getattr(struct, attribute)
        if nworld == 1 or shared.shape[0] == nworld:
            continue
        own = wp.empty((nworld, *shared.shape[1:]), dtype=shared.dtype, device=shared.device)
        with _torch_on_warps_stream(shared.device):
            as_torch(own).copy_(as_torch(shared))
        own._is_batched = True
        setattr(struct, attribute, own)
    return [getattr(struct, attribute) for struct, attribute in found]


def _torch_on_warps_stream(device: Any) -> AbstractContextManager[Any]:
    stream = torch.cuda.stream
    return stream(wp.stream_to_torch(device)) if device.is_cuda else nullcontext()


def put_variant_model(
    model: mujoco.MjModel, nworld: int, values: dict[str, np.ndarray], absent_geoms: np.ndarray
) -> Any:
    """Return a `mujoco_warp.Model` with per-world values, on the current device.

    Args:
        model: Compiled model.
        nworld: Number of worlds.
        values: Values of each world by field, (nworld, ...).
        absent_geoms: Geoms to hide in each world, (nworld, ngeom) bool.
    """
    wp_model = mjwarp.put_model(model)
    device = wp_model.geom_pos.device
    fields = [name for name in values if name not in COLLISION_MASKS]
    expand_arrays(wp_model, nworld, fields)
    with _torch_on_warps_stream(device):
        for name in fields:
            own = as_torch(getattr(wp_model, name))
            own.copy_(torch.as_tensor(values[name]).view(own.shape))
        if absent_geoms.any():
            hide_geoms(wp_model, torch.as_tensor(absent_geoms, device=wp.device_to_torch(device)))
    return wp_model


def hide_geoms(model: Any, absent: torch.Tensor) -> None:
    """Disable contacts of geoms, (N, ngeom) bool, by moving their bounds out of reach.

    Collision filters are compiled once for all environments, but the broad phase uses bounds, which
    can differ. A large negative radius is above every plane. Distant boxes, at a different position
    for each geom, do not overlap.

    Raises:
        ValueError: broad phase does not test bounds against planes, or boxes against boxes.
    """
    filters, known = int(model.opt.broadphase_filter), mjwarp.BroadphaseFilter
    if not (filters & known.PLANE and filters & (known.AABB | known.OBB)):
        raise ValueError(
            "SimulationCfg.broadphase_filter: expected 'plane' and one of 'aabb' and 'obb' for "
            "entities whose variants have different numbers or types of geoms; add them, use None "
            "(the default), or use --engine native."
        )
    as_torch(model.geom_rbound).masked_fill_(absent, -_FAR_AWAY / 10)
    centers = as_torch(model.geom_aabb)[:, :, 0]
    places = _FAR_AWAY * torch.arange(1, absent.shape[1] + 1, device=absent.device)
    centers.copy_(torch.where(absent[..., None], places[:, None], centers))


def find_device(device: torch.device) -> Any:
    """Return Warp's device of a torch device. Raises `EngineUnavailableError` if not found."""
    # Hide Warp's banner and compile messages by default.
    if os.environ.get("MJLAB_WARP_QUIET", "1").strip().lower() not in ("0", "false", "no"):
        wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    wp.init()
    if device.type == "cpu":
        return wp.get_device("cpu")
    is_usable = device.type == "cuda" and torch.cuda.is_available()
    count = wp.get_cuda_device_count() if is_usable else 0
    index = torch.cuda.current_device() if count and device.index is None else device.index or 0
    if index >= count:
        raise EngineUnavailableError(
            f"Warp engine device: expected one of "
            f"{['cpu', *(f'cuda:{i}' for i in range(count))]}, got {str(device)!r}, which needs an "
            "NVIDIA GPU; use --device cpu (faster with --engine native)."
        )
    return wp.get_cuda_device(index)
