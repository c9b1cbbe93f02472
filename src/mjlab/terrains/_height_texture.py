"""Colours for height fields."""

from __future__ import annotations

import mujoco
import numpy as np

from mjlab.terrains._resample import resample_linear

# The height above or below z = 0, in metres, at which colours stop changing.
_FULL_COLOR_HEIGHT = 0.75
# The hue at z = 0, a green; it goes to red above and to blue below.
_GROUND_HUE = 0.33


def color_by_height(
    spec: mujoco.MjSpec,
    noise: np.ndarray,
    unique_id: str,
    physical_heights: np.ndarray,
    texture_size: int = 128,
) -> str:
    """Add a texture that shows heights, and a material with it, and return the material's name.

    The scale is absolute and the same for all terrains: with `s = clip(h / 0.75, -1, 1)`, the hue
    is `0.33 (1 - s)` and saturation and value are `0.45 + 0.25 |s|`, so that ground at z = 0 is
    green, hills turn red and hollows blue.

    Args:
        spec: Where to add them.
        noise: Heights in pixels' units. They are not read: colours follow `physical_heights`.
        unique_id: Name of the texture and of the material.
        physical_heights: (rows, cols) heights above z = 0, in metres, [row, col].
        texture_size: Width and height of the texture, in pixels.
    """
    heights = resample_linear(np.asarray(physical_heights, float), (texture_size, texture_size))
    level = np.clip(heights / _FULL_COLOR_HEIGHT, -1.0, 1.0)
    vividness = 0.45 + 0.25 * np.abs(level)
    rgb = hsv_to_rgb(_GROUND_HUE * (1.0 - level), vividness, vividness)
    # Rows of a field go up along y, and rows of a texture go down.
    pixels = (rgb * 255.0).astype(np.uint8)[::-1]
    texture = spec.add_texture(
        name=unique_id,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=texture_size,
        height=texture_size,
        nchannel=3,
    )
    texture.data = pixels.tobytes()
    material = spec.add_material(name=unique_id)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = unique_id
    return unique_id


def hsv_to_rgb(hue: np.ndarray, saturation: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Convert arrays of any shape S to RGB of shape (*S, 3); everything is from 0 to 1.

    Channel n is `v - v s max(0, min(k, 4 - k, 1))` with `k = (n + 6 h) mod 6` and n = 5, 3, 1.
    """
    k = (np.array([5.0, 3.0, 1.0]) + 6.0 * hue[..., None]) % 6.0
    drop = np.clip(np.minimum(k, 4.0 - k), 0.0, 1.0)
    return (value * 1.0)[..., None] - (value * saturation)[..., None] * drop
