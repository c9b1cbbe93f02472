"""Random impulses on bodies: a wrench that acts for a while, then a pause."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import torch

from mjlab.envs.mdp._indexing import columns, num_selected
from mjlab.utils.lab_api.math import quat_apply, sample_uniform
from mjlab.utils.state import stateful

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.scene_entity_config import SceneEntityCfg
    from mjlab.viewer.debug_visualizer import DebugVisualizer

# Timers are sums of float32 time steps: without a margin an impulse of exactly k steps would
# last k or k + 1 steps depending on rounding.
_TIME_MARGIN = 1e-6


@stateful
class apply_body_impulse:
    """Pushes bodies with random wrenches, each environment on timers of its own (mode "step").

    A pause of `cooldown_s` comes first. Then force and torque act for `duration_s`, that is for
    `ceil(duration / step_dt)` environment steps, followed by the next pause, and so on.

    Params:
        force_range: Bounds of each force component (N), world axes.
        torque_range: Bounds of each torque component (N m), world axes.
        duration_s: Bounds of how long an impulse acts (s).
        cooldown_s: Bounds of a pause (s); read when the term is built.
        asset_cfg: Entity and bodies.
        body_point_offset: Where the force acts, relative to the body's centre of mass, in the
            frame of the body's link; this adds a torque. The centre of mass by default.
        viz_cfg: Drawing of active impulses: a mapping or object with fields of `VizCfg`.
    """

    @dataclass
    class VizCfg:
        """Drawing of active impulses, one arrow a body."""

        rgba: tuple[float, float, float, float] = (0.9, 0.2, 0.8, 0.9)
        """Color of an arrow."""
        scale: float = 0.005
        """Length of an arrow per force (m/N)."""
        width: float = 0.015
        """Width of an arrow (m)."""
        min_force: float = 1.0
        """Smallest force that is drawn (N)."""

    _transient = {"_asset", "_viz", "_bodies", "_num_bodies", "_cooldown_s", "_offset"}

    def __init__(self, cfg: Any, env: ManagerBasedRlEnv) -> None:
        params = cfg.params
        self._env = env
        self._asset_cfg: SceneEntityCfg = params["asset_cfg"]
        self._asset: Entity = env.scene[self._asset_cfg.name]
        self._bodies = columns(self._asset_cfg.body_ids, env.device)
        self._num_bodies = num_selected(self._asset_cfg.body_ids, self._asset.num_bodies)
        self._cooldown_s = tuple(params["cooldown_s"])
        self._offset = params.get("body_point_offset")
        self._viz = self._read_viz_cfg(params.get("viz_cfg"))
        self._remaining = torch.zeros(env.num_envs, dtype=torch.float32, device=env.device)
        self._active = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
        self._cooldown = sample_uniform(*self._cooldown_s, (env.num_envs,), env.device)

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        env_ids: torch.Tensor | None,
        force_range: tuple[float, float],
        torque_range: tuple[float, float],
        duration_s: tuple[float, float],
        cooldown_s: tuple[float, float],
        asset_cfg: SceneEntityCfg,
        body_point_offset: tuple[float, float, float] | None = None,
        viz_cfg: Any = None,
    ) -> None:
        """Advance all timers by one environment step; end and start impulses."""
        self._remaining -= env.step_dt
        expired = self._active & (self._remaining <= _TIME_MARGIN)
        self._stop(expired.nonzero().flatten())
        self._cooldown -= env.step_dt
        ready = ~self._active & (self._cooldown <= _TIME_MARGIN)
        ids = ready.nonzero().flatten()
        if len(ids) == 0:
            return
        shape = (len(ids), self._num_bodies, 3)
        force = sample_uniform(*force_range, shape, env.device)
        torque = sample_uniform(*torque_range, shape, env.device)
        if body_point_offset is not None:
            arm = self._arms(ids, body_point_offset)
            torque += torch.linalg.cross(arm, force)
        self._write(force, torque, ids)
        self._remaining[ids] = sample_uniform(*duration_s, (len(ids),), env.device)
        self._cooldown[ids] = sample_uniform(*self._cooldown_s, (len(ids),), env.device)
        self._active[ids] = True

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """End the impulses of environments (None means all), which then start with a pause."""
        mask = torch.zeros_like(self._active)
        mask[slice(None) if env_ids is None else env_ids] = True
        ids = mask.nonzero().flatten()
        self._cooldown[ids] = sample_uniform(*self._cooldown_s, (len(ids),), self._env.device)
        active = (mask & self._active).nonzero().flatten()
        if len(active):
            self._write_zero(active)
            self._active[active] = False

    def debug_vis(self, visualizer: DebugVisualizer) -> None:
        """Draw an arrow for each force that acts."""
        data = self._asset.data
        for env_idx in visualizer.get_env_indices(self._env.num_envs):
            if not self._active[env_idx]:
                continue
            start = data.body_com_pos_w[env_idx, self._bodies]
            if self._offset is not None:
                ids = torch.tensor([env_idx], device=self._env.device)
                start = start + self._arms(ids, self._offset)[0]
            force = data.body_external_force[env_idx, self._bodies]
            for begin, vector in zip(start.cpu().numpy(), force.cpu().numpy(), strict=True):
                if (vector @ vector) ** 0.5 >= self._viz.min_force:
                    end = begin + vector * self._viz.scale
                    visualizer.add_arrow(begin, end, self._viz.rgba, width=self._viz.width)

    @classmethod
    def _read_viz_cfg(cls, given: Any) -> VizCfg:
        """Take the fields that `given` (None, a mapping or any object with attributes) has."""
        names = [field.name for field in fields(cls.VizCfg)]
        if isinstance(given, Mapping):
            return cls.VizCfg(**{name: given[name] for name in names if name in given})
        return cls.VizCfg(**{name: getattr(given, name) for name in names if hasattr(given, name)})

    def _arms(self, ids: torch.Tensor, offset: tuple[float, float, float]) -> torch.Tensor:
        """Return the offset in world axes, (K, bodies, 3)."""
        # The link's frame, not the one of the principal axes of inertia.
        quat = self._asset.data.body_link_quat_w[ids][:, self._bodies]
        point = torch.tensor(offset, dtype=quat.dtype, device=quat.device)
        return quat_apply(quat, point.expand(*quat.shape[:-1], 3))

    def _stop(self, ids: torch.Tensor) -> None:
        if len(ids) == 0:
            return
        self._write_zero(ids)
        self._active[ids] = False
        self._cooldown[ids] = sample_uniform(*self._cooldown_s, (len(ids),), self._env.device)

    def _write_zero(self, ids: torch.Tensor) -> None:
        zero = torch.zeros(
            len(ids), self._num_bodies, 3, dtype=torch.float32, device=self._env.device
        )
        self._write(zero, zero, ids)

    def _write(self, force: torch.Tensor, torque: torch.Tensor, ids: torch.Tensor) -> None:
        self._asset.write_external_wrench_to_sim(force, torque, env_ids=ids, body_ids=self._bodies)
