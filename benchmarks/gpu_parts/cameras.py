"""Images per second of Warp's cameras in the scene of lifting a cube, over bare `mujoco_warp.render`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import mujoco_warp
import warp
from measure import Row, alternate

from gpu_parts.device import wait
from gpu_parts.options import Options
from gpu_parts.tasks import LIFT_CUBE_RGB, close, stepped_env
from mjlab.envs import ManagerBasedRlEnv
from mjlab.sim.engine import CameraView

mjw: Any = mujoco_warp
wp: Any = warp

_SENSOR = "camera_d405"
_KINDS = {"depth and segmentation": ("depth", "segmentation"), "colors": ("rgb",)}


def measure(options: Options) -> Iterator[Row]:
    """Render both kinds of images in two sizes."""
    for num_envs, size in options.sized(((4096, 32), (512, 128)), ((2, 8),)):
        env, _ = stepped_env(LIFT_CUBE_RGB, num_envs, options.device, options.sized(10, 1))
        for name, types in _KINDS.items():
            yield _row(env, name, types, size, options)
        close(env)


def _row(
    env: ManagerBasedRlEnv, name: str, types: tuple[str, ...], size: int, options: Options
) -> Row:
    sim, sensor = env.sim, env.scene[_SENSOR]
    views = (CameraView(sensor.camera_idx, size, size, types, sensor.view.geom_groups),)
    images = sim.render(views)[0]
    seen = getattr(images, types[0]).float()
    if not float(seen.std()) > 0:
        raise RuntimeError(f"The images of {name} show nothing.")
    bare = _bare(env, views)
    steps, repeats = options.sized((5, 9), (1, 2))
    time, bare_time = alternate(
        lambda: sim.render(views),
        bare,
        steps=steps,
        repeats=repeats,
        warm_up=2,
        wait=lambda: wait(options.device),
    )
    return Row(
        f"cameras, {size} x {size}, lift-cube scene, {env.num_envs:,} envs: {name}",
        f"{env.num_envs / time:,.0f} images/s ({1e3 * time:.2f} ms for all)",
        f"bare `mujoco_warp.render`: {env.num_envs / bare_time:,.0f} images/s",
        "",
        None,
    )


def _bare(env: ManagerBasedRlEnv, views: tuple[CameraView, ...]) -> Callable[[], None]:
    """Return a renderer of the same views by `mujoco_warp` alone."""
    device = wp.get_device(env.device)
    model, data = env.sim.wp_model, env.sim.wp_data
    context = env.sim.render_context(views, views[0])

    def work() -> None:
        with wp.ScopedDevice(device):
            mjw.refit_bvh(model, data, context)
            mjw.render(model, data, context)

    if not device.is_cuda:
        return work
    wait(env.device)
    work()
    with wp.ScopedCapture(device=device) as capture:
        work()
    return lambda: wp.capture_launch(capture.graph)
