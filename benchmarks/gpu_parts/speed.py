"""`env.step` on Warp over a bare `mujoco_warp` loop in a captured graph, alternating.

The bare loop steps the environments' models, including randomized fields, starts each step from
the states of the environments, with the same controls, and casts the same rays. The difference is the
overhead of managers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import mujoco_warp
import torch
import warp
from measure import Row, alternate

from gpu_parts.device import Memory, counted_waits, wait
from gpu_parts.options import Options
from gpu_parts.tasks import (
    CARTPOLE,
    G1_FLAT,
    G1_ROUGH,
    GO1_FLAT,
    GO1_ROUGH,
    close,
    stepped_env,
)
from mjlab.envs import ManagerBasedRlEnv
from mjlab.sim.engine import RayQuery
from mjlab.sim.randomization import expand_model_fields
from mjlab.sim.sim_data import TorchArray

mjw: Any = mujoco_warp
wp: Any = warp

_STATE = ("qpos", "qvel", "act", "ctrl", "qacc_warmstart", "mocap_pos", "mocap_quat")
_STEPS_BEFORE = 25


class BareWarp:
    """The physics of one environment step on `mujoco_warp`, in one graph."""

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        self._env, sim = env, env.sim
        engine: Any = sim._engine
        self._device = wp.get_device(env.device)
        with wp.ScopedDevice(self._device):
            self._model = mjw.put_model(sim.mj_model)
            # Same order as the engine.
            self._model.opt.warn_overflow = 0
            if self._device.is_cuda:
                self._model.opt.graph_conditional = wp.is_conditional_graph_supported()
            sim.cfg.apply_wp_opt(self._model.opt)
            self._data = mjw.put_data(
                sim.mj_model,
                engine._host,
                env.num_envs,
                nconmax=sim.wp_data.naconmax // env.num_envs,
                njmax=sim.wp_data.njmax,
            )
            names = sorted(sim.expanded_fields)
            expand_model_fields(self._model, env.num_envs, names)
            wait(env.device)
            for name in names:
                owner = self._model if hasattr(self._model, name) else self._model.opt
                own = TorchArray(getattr(owner, name)).tensor
                own.copy_(getattr(sim.model, name).view(own.shape))
            if "stat.meaninertia" in engine.model_fields:
                expand_model_fields(self._model, env.num_envs, ["stat.meaninertia"])
                wait(env.device)
                inertia = TorchArray(self._model.stat.meaninertia).tensor
                inertia.copy_(engine.model_fields["stat.meaninertia"])
            self._rays = [_Rays(env, query) for query in _recorded_rays(env)]
            wait(env.device)
            # The first call loads kernels. On a GPU the next ones replay a graph.
            self._work()
            self._replay: Callable[[], None] = self._work
            if self._device.is_cuda:
                with wp.ScopedCapture(device=self._device) as capture:
                    self._work()
                self._replay = lambda: wp.capture_launch(capture.graph)

    @property
    def num_rays(self) -> int:
        """Number of rays per environment."""
        return sum(rays.count for rays in self._rays)

    def same_states(self) -> None:
        """Copy states and controls of the environments."""
        for name in _STATE:
            own = TorchArray(getattr(self._data, name)).tensor
            own.copy_(getattr(self._env.sim.data, name).view(own.shape))

    def _work(self) -> None:
        for _ in range(self._env.cfg.decimation):
            mjw.step(self._model, self._data)
        mjw.forward(self._model, self._data)
        for rays in self._rays:
            rays.cast(self._model, self._data)

    def __call__(self) -> None:
        with wp.ScopedDevice(self._device):
            self._replay()


class _Rays:
    """Rays of one query of the environments, as arguments of `mujoco_warp`."""

    def __init__(self, env: ManagerBasedRlEnv, query: RayQuery) -> None:
        origins, groups, excluded = query.origins, query.geom_groups, query.exclude_body_ids
        shape, device = tuple(origins.shape[:2]), origins.device
        self.count = shape[1]
        if excluded is None:
            excluded = torch.full(shape[1:], -1, device=device)
        # Keep references: Warp arrays do not own the memory of their tensors.
        self._tensors = (
            origins.contiguous().clone(),
            query.directions.contiguous().clone(),
            excluded.to(torch.int32).contiguous(),
            torch.empty(shape, device=device),
            torch.empty(shape, dtype=torch.int32, device=device),
            torch.empty((*shape, 3), device=device),
        )
        kinds = (wp.vec3, wp.vec3, None, None, None, wp.vec3)
        wait(env.device)
        self._arrays = [
            wp.from_torch(tensor) if kind is None else wp.from_torch(tensor, dtype=kind)
            for tensor, kind in zip(self._tensors, kinds, strict=True)
        ]
        present = {int(group) for group in env.sim.mj_model.geom_group}
        chosen = sorted(g for g in present if groups is None or min(max(g, 0), 5) in groups)
        self._context = mjw.create_render_context(
            env.sim.mj_model,
            env.num_envs,
            cam_active=[],
            use_textures=False,
            enabled_geom_groups=chosen,
        )
        self._all_groups = wp.types.vector(length=6, dtype=float)(*[-1.0] * 6)

    def cast(self, model: Any, data: Any) -> None:
        """Cast the rays at the current poses."""
        origins, directions, excluded, distances, geoms, normals = self._arrays
        mjw.refit_bvh(model, data, self._context)
        mjw.rays(
            model,
            data,
            origins,
            directions,
            self._all_groups,
            True,
            excluded,
            distances,
            geoms,
            normals,
            self._context,
        )


def _recorded_rays(env: ManagerBasedRlEnv) -> list[RayQuery]:
    """Return all ray queries of one step."""
    queries: list[RayQuery] = []
    engine: Any = env.sim._engine
    original = engine.raycast
    engine.raycast = lambda query: queries.append(query) or original(query)
    try:
        env.sim.sense()
    finally:
        del engine.raycast
    return queries


def measure(options: Options) -> Iterator[Row]:
    """Measure every task; yield three rows each."""
    tasks = options.sized((CARTPOLE, GO1_FLAT, G1_FLAT, GO1_ROUGH, G1_ROUGH), (CARTPOLE, GO1_ROUGH))
    # Exclude the GPU contexts of libraries.
    close(stepped_env(options.sized(GO1_FLAT, CARTPOLE), 2, options.device, 1)[0])
    for task in tasks:
        yield from _measure_task(task, options)


def _measure_task(task: str, options: Options) -> Iterator[Row]:
    device, num_envs = options.device, options.sized(4096, 2)
    memory = Memory(device)
    env, actions = stepped_env(task, num_envs, device, options.sized(_STEPS_BEFORE, 2))
    taken = memory.shown()
    steps = options.sized(50, 2)
    with counted_waits(device) as waits:
        for _ in range(steps):
            env.step(actions)
    bare = BareWarp(env)
    repeats, per_repeat = options.sized((15, 10), (2, 1))
    env_time, bare_time = alternate(
        lambda: env.step(actions),
        bare,
        steps=per_repeat,
        repeats=repeats,
        warm_up=3,
        before=bare.same_states,
        wait=lambda: wait(device),
    )
    rays = f", the same {bare.num_rays} rays" if bare.num_rays else ""
    where = f"{task}, {num_envs:,} envs"
    yield Row(
        f"{where}: `env.step` over bare `mujoco_warp`{rays}",
        f"{bare_time / env_time:.2f} ({num_envs / env_time:,.0f} env-steps/s, "
        f"{1e3 * env_time:.2f} ms a step)",
        f"bare loop: {num_envs / bare_time:,.0f} env-steps/s, {1e3 * bare_time:.2f} ms",
        "",
        None,
    )
    yield Row(
        f"{where}: waits of the host for the GPU in a step", waits.per_step(steps), "", "", None
    )
    yield Row(f"{where}: GPU memory of the environments", taken, "", "", None)
    del bare
    close(env)
