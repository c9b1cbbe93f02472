"""Editors that add lights and cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import mujoco

from mjlab.utils.spec_editors.base import SpecCfg, find_body, mujoco_enum

# The modes of lights and of cameras have the same names.
_MODES = {
    "fixed": mujoco.mjtCamLight.mjCAMLIGHT_FIXED,
    "track": mujoco.mjtCamLight.mjCAMLIGHT_TRACK,
    "trackcom": mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM,
    "targetbody": mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODY,
    "targetbodycom": mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODYCOM,
}
_LIGHT_TYPES = {
    "spot": mujoco.mjtLightType.mjLIGHT_SPOT,
    "directional": mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
}
_LIGHT_FIELDS = ("name", "castshadow", "pos", "dir", "cutoff", "exponent", "diffuse")
_LIGHT_FIELDS += ("specular", "ambient", "active", "attenuation")


@dataclass
class LightCfg(SpecCfg):
    """Adds a light to a body."""

    name: str | None = None
    """Name of the light, if it has one."""
    body: str = "world"
    """Name of the body it belongs to."""
    mode: str = "fixed"
    """fixed, track, trackcom, targetbody or targetbodycom."""
    target: str | None = None
    """Name of the body the last two modes point at."""
    type: Literal["spot", "directional"] = "spot"
    """Kind of light."""
    castshadow: bool = True
    """Whether things it falls on cast shadows."""
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position in the body frame, m."""
    dir: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """Direction in the body frame."""
    cutoff: float = 45.0
    """Half the opening angle of a spot, degrees."""
    exponent: float = 10.0
    """How fast a spot fades towards its edge."""
    diffuse: tuple[float, float, float] | None = None
    """Diffuse colour; None keeps MuJoCo's."""
    specular: tuple[float, float, float] | None = None
    """Specular colour; None keeps MuJoCo's."""
    ambient: tuple[float, float, float] | None = None
    """Ambient colour; None keeps MuJoCo's."""
    active: bool = True
    """Whether it is on."""
    attenuation: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Constant, linear and quadratic attenuation with distance."""

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Add the light. Raises `ValueError`, with the choices, for an unknown body or mode."""
        self.validate()
        light = find_body(self, spec, self.body).add_light(
            mode=mujoco_enum(self, "mode", _MODES),
            type=mujoco_enum(self, "type", _LIGHT_TYPES),
        )
        _set_target(self, spec, light)
        for field in _LIGHT_FIELDS:
            value = getattr(self, field)
            if value is not None:
                setattr(light, field, value)

    def validate(self) -> None:
        """Raise `ValueError` for an unknown mode or type, or a mode without its target."""
        mujoco_enum(self, "type", _LIGHT_TYPES)
        _validate_mode(self)


@dataclass
class CameraCfg(SpecCfg):
    """Adds a camera to a body."""

    name: str
    """Name of the camera."""
    body: str = "world"
    """Name of the body it belongs to."""
    mode: str = "fixed"
    """fixed, track, trackcom, targetbody or targetbodycom."""
    target: str | None = None
    """Name of the body the last two modes point at."""
    fovy: float = 45.0
    """Vertical field of view, degrees."""
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position in the body frame, m."""
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Orientation (w, x, y, z) in the body frame."""

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Add the camera. Raises `ValueError`, with the choices, for an unknown body or mode."""
        self.validate()
        camera = find_body(self, spec, self.body).add_camera(
            name=self.name,
            mode=mujoco_enum(self, "mode", _MODES),
            fovy=self.fovy,
            pos=self.pos,
            quat=self.quat,
        )
        _set_target(self, spec, camera)

    def validate(self) -> None:
        """Raise `ValueError` for an unknown mode, or one without its target."""
        _validate_mode(self)


def _validate_mode(cfg: LightCfg | CameraCfg) -> None:
    mujoco_enum(cfg, "mode", _MODES)
    if cfg.mode.startswith("target") and cfg.target is None:
        raise ValueError(
            f"{type(cfg).__name__} {cfg.name!r} has mode {cfg.mode!r}, which needs `target`, the "
            "name of the body to point at."
        )


def _set_target(cfg: LightCfg | CameraCfg, spec: mujoco.MjSpec, element: Any) -> None:
    if cfg.target is not None:
        find_body(cfg, spec, cfg.target)
        element.targetbody = cfg.target
