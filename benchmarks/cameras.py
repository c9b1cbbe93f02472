"""Images a second of the native engine's cameras, beside `mjbatch`'s rays and MuJoCo's renderer.

The scene is that of `Mjlab-Lift-Cube-Yam-Rgb`: the wrist camera of the YAM arm at 32 x 32 pixels,
which sees the cube, the ground and the arm's collision shapes. The arms stand at random poses near
home. All take turns in one run, so that their ratios hold on a machine that others use too:

- depth and segmentation, and colours as well, by `Simulation.render` (what `sim.sense()` calls);
- the bare rays of `mjbatch`, one for each pixel against all geoms, which yield a depth and a geom;
- MuJoCo's own offscreen renderer, an environment after another, where OpenGL is available.

Run alone: `python benchmarks/cameras.py`, with the number of environments if not 512.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import mjbatch
import mujoco
import numpy as np
import torch
from timing import alternate

from mjlab.envs import ManagerBasedRlEnv
from mjlab.sim import Simulation
from mjlab.sim.rendering import CameraView
from mjlab.tasks.registry import load_env_cfg
from mjlab.viewer.errors import RenderingUnavailableError
from mjlab.viewer.gl_context import open_renderer

TASK, SENSOR, SIZE = "Mjlab-Lift-Cube-Yam-Rgb", "camera_d405", 32
# What the issue asks for: images a second of two cores, and times MuJoCo's renderer in software.
WANTED = {"depth and segmentation": 4000.0, "colours": 2500.0}
WANTED_OVER_RENDERER = 100.0
# The renderer is measured on so many environments of each turn.
_RENDERER_IMAGES = 8


class BareRays:
    """One ray for each pixel of the wrist camera, against all geoms of its groups."""

    def __init__(self, sim: Simulation, camera_id: int, groups: tuple[int, ...]) -> None:
        model = sim.mj_model
        self._batch = mjbatch.Batch(model, sim.num_envs)
        for name in ("qpos", "mocap_pos", "mocap_quat"):
            self._batch.bind(name)[:] = getattr(sim.data, name).numpy()
        rays = _pixel_rays(model.cam_fovy[camera_id])
        mat, pos = sim.data.cam_xmat[:, camera_id], sim.data.cam_xpos[:, camera_id]
        shape = (sim.num_envs, len(rays))
        self._directions = np.ascontiguousarray((rays @ mat.transpose(1, 2)).numpy())
        self._origins = np.ascontiguousarray(pos[:, None].expand(*shape, 3).numpy())
        self._mask = np.zeros(6, dtype=np.uint8)
        self._mask[list(groups)] = 1
        self.distances = np.empty(shape, dtype=np.float32)
        self.geoms = np.empty(shape, dtype=np.int32)

    def __call__(self) -> None:
        self._batch.rays(
            self._origins, self._directions, self.distances, self.geoms, geomgroup=self._mask
        )


def _pixel_rays(fovy: float) -> torch.Tensor:
    """Return unit vectors (SIZE^2, 3) through the centres of pixels, in the camera's frame."""
    half = np.tan(np.radians(fovy) / 2)
    x = (2 * (torch.arange(SIZE) + 0.5) / SIZE - 1) * half
    v, u = torch.meshgrid(-x, x, indexing="ij")
    rays = torch.stack((u, v, -torch.ones_like(u)), dim=-1).view(-1, 3).float()
    return rays / rays.norm(dim=-1, keepdim=True)


def renderer_of(sim: Simulation, camera_id: int) -> tuple[Callable[[], None] | None, str]:
    """Return what renders some depth images by OpenGL, and what with; None and why not."""
    try:
        renderer = open_renderer(sim.mj_model, SIZE, SIZE)
    except RenderingUnavailableError as error:
        return None, str(error).splitlines()[0]
    from OpenGL import GL

    # A current context is needed to ask.
    data = mujoco.MjData(sim.mj_model)
    renderer.update_scene(data, camera_id)
    renderer.render()
    name = (GL.glGetString(GL.GL_RENDERER) or b"unknown").decode()
    renderer.enable_depth_rendering()

    def images() -> None:
        for i in range(_RENDERER_IMAGES):
            sim.copy_to_host(i, data)
            mujoco.mj_kinematics(sim.mj_model, data)
            mujoco.mj_camlight(sim.mj_model, data)
            renderer.update_scene(data, camera_id)
            renderer.render()

    return images, name


def main() -> None:
    """Measure, and print one line for each."""
    num_envs = int(sys.argv[1]) if len(sys.argv) > 1 else 512
    cfg = load_env_cfg(TASK)
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = num_envs, 0, "native"
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    for _ in range(20):
        env.step(torch.randn(num_envs, 7) * 0.5)
    sim, sensor = env.sim, env.scene[SENSOR]
    groups, camera = sensor.view.geom_groups, sensor.camera_idx
    both, colours = (
        (CameraView(camera, SIZE, SIZE, types, groups),)
        for types in (("depth", "segmentation"), ("rgb",))
    )
    bare = BareRays(sim, camera, groups)
    rendered, name = renderer_of(sim, camera)
    samples = [lambda: sim.render(both), lambda: sim.render(colours), bare]
    counts = [num_envs, num_envs, num_envs]
    names = ["depth and segmentation", "colours", "bare mjbatch.rays"]
    if rendered is not None:
        samples, counts = [*samples, rendered], [*counts, _RENDERER_IMAGES]
        names.append("MuJoCo's renderer, depth")
    begin = time.perf_counter()
    times = alternate(*samples, steps=1, repeats=25, warm_up=2)
    speeds = dict(zip(names, (n / t for n, t in zip(counts, times, strict=True)), strict=True))
    same = (
        sim.render(both)[0].segmentation[..., 0].reshape(num_envs, -1).numpy() == bare.geoms
    ).mean()
    print(f"{sim.capabilities.description}; {num_envs} environments, {SIZE} x {SIZE} pixels, "
          f"{time.perf_counter() - begin:.0f} s, pixels as by bare rays: {100 * same:.2f} %")  # fmt: skip
    print(f"OpenGL: {name}")
    for what, speed in speeds.items():
        over_rays = speed / speeds["bare mjbatch.rays"]
        line = f"{what:26} {speed:8.0f} images/s  {over_rays:6.2f} x the bare rays"
        if rendered is not None:
            ratio = speed / speeds["MuJoCo's renderer, depth"]
            line += f"  {ratio:7.1f} x MuJoCo's renderer"
        print(line + (f"  (wanted: {WANTED[what]:.0f}/s)" if what in WANTED else ""))
    if rendered is not None:
        print(f"wanted: {WANTED_OVER_RENDERER:.0f} x MuJoCo's renderer in software")


if __name__ == "__main__":
    main()
