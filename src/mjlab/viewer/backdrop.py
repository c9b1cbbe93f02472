"""What lies around the robot in rendered images: a sky, and sunlight where the camera looks."""

from __future__ import annotations

import mujoco
import numpy as np

# The sky above, as a colour in [0, 1]; towards the horizon it becomes the haze of the model.
_ZENITH = (0.35, 0.52, 0.70)
# Least half width, in metres, of the square around the target in which sunlight casts shadows.
_MIN_SHADOW_RANGE = 2.0
_SUN_HEIGHT = 3.0


def has_sky(model: mujoco.MjModel) -> bool:
    """Whether the model brings a sky of its own."""
    return bool((model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).any())


def paint_sky(pixels: np.ndarray, renderer: mujoco.Renderer) -> None:
    """Paint a sky where the image that `renderer` has just drawn shows nothing.

    Args:
        pixels: The image, (height, width, 3), uint8, rows from the top; written in place.
        renderer: The renderer, whose buffers still hold the image.
    """
    depth = np.empty(pixels.shape[:2], dtype=np.float32)
    context = renderer._mjr_context
    mujoco.mjr_readPixels(None, depth, renderer._rect, context)
    # The buffer is read from the bottom.
    zero_far = context.readDepthMap == mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
    nothing = depth[::-1] == (0.0 if zero_far else 1.0)
    rows = np.flatnonzero(nothing.any(axis=1))
    if len(rows) == 0:
        return
    horizon = np.asarray(renderer.model.vis.rgba.haze[:3], dtype=float)
    share = np.linspace(0.0, 1.0, rows[-1] + 1)[:, None]
    colors = (1.0 - share) * np.array(_ZENITH) + share * horizon
    sky = np.zeros((len(pixels), 1, 3), dtype=np.uint8)
    sky[: rows[-1] + 1, 0] = np.round(255.0 * colors)
    # See-through shapes, such as ghosts, are drawn over black, and are not in the depths. How much of
    # what is behind they let through is not known any more; half is what ghosts do.
    through = nothing & pixels.any(axis=2)
    tinted = np.minimum(pixels.astype(np.uint16) + sky // 2, 255)
    np.copyto(pixels, sky, where=(nothing & ~through)[:, :, None])
    np.copyto(pixels, tinted.astype(np.uint8), where=through[:, :, None])


def prepare_sun(model: mujoco.MjModel, distance: float) -> None:
    """Make directional lights one sun, whose shadows are near the camera's target, and fine.

    A ground and a grid of terrain bring a light each, and under two everything would be white.

    Args:
        model: A private copy of the model, with its extent set.
        distance: Distance from the camera to its target, in metres.
    """
    suns = np.flatnonzero(_is_directional(model))
    model.light_diffuse[suns] /= max(len(suns), 1)
    model.light_castshadow[suns[1:]] = False
    model.vis.map.shadowclip = max(_MIN_SHADOW_RANGE, distance) / model.stat.extent


def move_sun(model: mujoco.MjModel, data: mujoco.MjData, target: np.ndarray) -> None:
    """Bring directional lights over `target` (3,), so that its shadow follows it.

    Where such a light stands only decides where it casts shadows.
    """
    suns = _is_directional(model)
    data.light_xpos[suns] = target - _SUN_HEIGHT * data.light_xdir[suns]


def _is_directional(model: mujoco.MjModel) -> np.ndarray:
    return model.light_type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
