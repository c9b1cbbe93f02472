"""Images per second of the native engine's cameras, next to `mujoco.batch`'s rays and MuJoCo's renderer.

The scene is that of `Mjlab-Lift-Cube-Yam-Rgb`: the wrist camera of the YAM arm at 32 x 32 pixels,
with the cube, the ground and the arm's collision shapes in view. The arms stand at random poses near
home. All alternate in one run, so that ratios and CPU time per image hold on a shared machine:

- depth and segmentation, and colors as well, by `Simulation.render` (what `sim.sense()` calls);
- the bare rays of `mujoco.batch`, one per pixel against all geoms, for depth and geom id;
- MuJoCo's own offscreen renderer, one environment after another, if OpenGL is available: the same
  two images, and colors of the model, with shadows.

Run alone: `python benchmarks/cameras.py`, with the number of environments if not 512. In software
OpenGL needs `MUJOCO_GL=osmesa`.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import torch
from measure import Row, alternate, show
from mujoco.batch import Batch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.sim import Simulation
from mjlab.sim.engine import CameraView
from mjlab.tasks.registry import load_env_cfg
from mjlab.viewer.offscreen_renderer import RenderingUnavailableError, open_renderer

TASK, SENSOR, SIZE = "Mjlab-Lift-Cube-Yam-Rgb", "camera_d405", 32
# Images a second of two cores that are to be reached.
BOTH, COLORS = "depth and segmentation", "colors"
WANTED = {BOTH: 4000.0, COLORS: 2500.0}
# Target speed-up over MuJoCo's software renderer on the same images.
TIMES_RENDERER = {BOTH: 100.0, COLORS: 0.0}
BARE, RENDERER = "bare `mujoco.batch` rays", "MuJoCo's renderer"
REPEATS = 15


class BareRays:
    """One ray for each pixel of the wrist camera, against all geoms of its groups."""

    def __init__(self, sim: Simulation, camera_id: int, groups: tuple[int, ...]) -> None:
        model = sim.mj_model
        self._batch = Batch(model, sim.num_envs)
        for name in ("qpos", "mocap_pos", "mocap_quat"):
            self._batch.bind(name)[:] = getattr(sim.data, name).numpy()
        rays = _pixel_rays(model.cam_fovy[camera_id])
        mat, pos = sim.data.cam_xmat[:, camera_id], sim.data.cam_xpos[:, camera_id]
        shape = (sim.num_envs, len(rays))
        self._directions = np.ascontiguousarray((rays @ mat.transpose(1, 2)).numpy())
        self._origins = np.ascontiguousarray(pos[:, None].expand(*shape, 3).numpy())
        self._mask = np.zeros(6, dtype=np.uint8)
        self._mask[list(groups)] = 1
        self.distances = np.empty(shape)
        self.geoms = np.empty(shape, dtype=np.int32)

    def __call__(self) -> None:
        self.distances, self.geoms = self._batch.ray(
            self._origins, self._directions, geomgroup=self._mask
        )


def _pixel_rays(fovy: float) -> torch.Tensor:
    """Return unit vectors (SIZE^2, 3) through the centers of pixels, in the camera's frame."""
    half = np.tan(np.radians(fovy) / 2)
    x = (2 * (torch.arange(SIZE) + 0.5) / SIZE - 1) * half
    v, u = torch.meshgrid(-x, x, indexing="ij")
    rays = torch.stack((u, v, -torch.ones_like(u)), dim=-1).view(-1, 3).float()
    return rays / rays.norm(dim=-1, keepdim=True)


class Renderers:
    """MuJoCo's offscreen renderer, of one environment after another."""

    def __init__(self, sim: Simulation, camera_id: int) -> None:
        self._sim, self._camera_id = sim, camera_id
        self._data = mujoco.MjData(sim.mj_model)
        self._renderer = open_renderer(sim.mj_model, SIZE, SIZE)

    def _pose(self, env: int) -> None:
        self._sim.copy_to_host(env, self._data)
        mujoco.mj_kinematics(self._sim.mj_model, self._data)
        mujoco.mj_camlight(self._sim.mj_model, self._data)
        self._renderer.update_scene(self._data, self._camera_id)

    def colors(self, count: int) -> None:
        """Render as the model has it, with shadows; their map is 8192 x 8192 pixels."""
        for env in range(count):
            self._pose(env)
            self._renderer.render()

    def depth_and_segmentation(self, count: int) -> None:
        """Render depth and segmentation, two separate images for this renderer."""
        renderer = self._renderer
        for env in range(count):
            self._pose(env)
            renderer.enable_depth_rendering()
            renderer.render()
            renderer.disable_depth_rendering()
            renderer.enable_segmentation_rendering()
            renderer.render()
            renderer.disable_segmentation_rendering()


def build(num_envs: int) -> ManagerBasedRlEnv:
    """Build the task, with arms near home."""
    cfg = load_env_cfg(TASK)
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = num_envs, 0, "native"
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    for _ in range(20):
        env.step(0.5 * torch.randn(num_envs, 7))
    return env


def measure(num_envs: int = 512) -> list[Row]:
    """Measure both kinds of images, next to bare rays and, if OpenGL is available, the renderer."""
    env = build(num_envs)
    sim, sensor = env.sim, env.scene[SENSOR]
    groups, camera = sensor.view.geom_groups, sensor.camera_idx
    views = {
        name: (CameraView(camera, SIZE, SIZE, types, groups),)
        for name, types in ((BOTH, ("depth", "segmentation")), (COLORS, ("rgb",)))
    }
    samples: dict[str, tuple[Callable[[], Any], int]] = {
        name: (functools.partial(sim.render, view), num_envs) for name, view in views.items()
    }
    bare = BareRays(sim, camera, groups)
    samples[BARE] = (bare, num_envs)
    samples |= renderer_samples(sim, camera)
    times = alternate(*(s for s, _ in samples.values()), steps=1, repeats=REPEATS, warm_up=2)
    speeds = {
        name: count / time for (name, (_, count)), time in zip(samples.items(), times, strict=True)
    }
    seen = sim.render(views[BOTH])[0].segmentation
    assert seen is not None
    same = (seen[..., 0].reshape(num_envs, -1).numpy() == bare.geoms).mean()
    env.close()
    return [row(name, speeds, same) for name in WANTED]


def renderer_samples(sim: Simulation, camera: int) -> dict[str, tuple[Callable[[], Any], int]]:
    """Return what MuJoCo's renderer draws for each kind of images, and of how many environments."""
    try:
        renderers = Renderers(sim, camera)
    except RenderingUnavailableError:
        return {}
    return {
        f"{RENDERER}, {BOTH}": (lambda: renderers.depth_and_segmentation(8), 8),
        f"{RENDERER}, {COLORS}": (lambda: renderers.colors(1), 1),
    }


def row(name: str, speeds: dict[str, float], same: float) -> Row:
    """Return the line of one kind of images; `same` is the share of pixels equal to bare rays'."""
    beside = {BARE: speeds[BARE]} | {k: v for k, v in speeds.items() if k.startswith(RENDERER)}
    shown = "; ".join(f"{k}: {v:,.4g}/s ({speeds[name] / v:,.3g} x)" for k, v in beside.items())
    wanted, times = f"{WANTED[name]:,.0f} images/s", TIMES_RENDERER[name]
    reached = speeds[name] >= WANTED[name]
    if times:
        wanted += f", and {times:.0f} x MuJoCo's renderer"
        reached = reached and speeds[name] >= times * speeds.get(f"{RENDERER}, {name}", np.inf)
    agreed = f"; {same:.2%} of pixels show what bare rays meet" if name == BOTH else ""
    return Row(
        f"cameras, {SIZE} x {SIZE}, lift-cube scene, native: {name}",
        f"{speeds[name]:,.0f} images/s{agreed}",
        shown if len(beside) > 1 else f"{shown}; no OpenGL here",
        wanted,
        reached,
    )


if __name__ == "__main__":
    print(show(measure(int(sys.argv[1]) if len(sys.argv) > 1 else 512)))
