"""The spec that a scene starts from: how it looks, and nothing else."""

from __future__ import annotations

import mujoco


def make_base_spec(extent: float | None) -> mujoco.MjSpec:
    """Return a spec without elements or options, with mjlab's visual defaults.

    `extent` is the size of the scene for viewers, in metres; None lets the compiler compute it.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "mjlab scene"
    visual = spec.visual
    visual.headlight.diffuse[:] = 0.6
    visual.headlight.ambient[:] = 0.3
    visual.headlight.specular[:] = 0.0
    visual.rgba.force[:] = (1.0, 0.0, 0.0, 1.0)
    visual.rgba.haze[:] = (0.15, 0.25, 0.35, 1.0)
    visual.global_.azimuth = 135
    visual.global_.elevation = -25
    visual.global_.offwidth = 1920
    visual.global_.offheight = 1080
    visual.map.force = 0.005
    visual.scale.forcewidth = 0.25
    visual.scale.contactwidth = 0.4
    visual.scale.contactheight = 0.15
    visual.scale.framelength = 5.0
    visual.scale.framewidth = 0.3
    visual.quality.shadowsize = 8192
    spec.stat.meansize = 0.03
    if extent is not None:
        spec.stat.extent = extent
    return spec
