"""Sky, light and ground of the pages in the browser."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np
import viser
from mjviser.conversions import get_body_name, is_fixed_body

# Colors in [0, 255].
_ZENITH, _HORIZON = (143, 179, 219), (238, 241, 246)
_GROUND, _CELL_LINE, _SECTION_LINE = (203, 210, 219), (188, 196, 207), (172, 181, 194)
_BRAND = (47, 102, 144)
# Share of the image above which the sky is bluer than the horizon.
_SKY_SHARE = 0.45
_FADE_DISTANCE = 35.0
_SKY_LIGHT, _GROUND_LIGHT = (225, 235, 250), (190, 190, 185)
_PLAIN_LIGHT = 1.2


def set_look(server: viser.ViserServer, model: mujoco.MjModel) -> None:
    """Set sky, light and ground of a page with the scene of `model`, drawn by mjviser."""
    scene = server.scene
    share = np.clip(np.linspace(0.0, 1.0 / _SKY_SHARE, 256), 0.0, 1.0)[:, None]
    sky = (1.0 - share) * np.array(_ZENITH) + share * np.array(_HORIZON)
    scene.set_background_image(np.repeat(sky.astype(np.uint8)[:, None], 2, axis=1), format="png")
    scene.configure_default_lights(cast_shadow=True)
    # Light from the sky, so that dark robots are not black silhouettes.
    scene.add_light_hemisphere(
        "/sky_light", sky_color=_SKY_LIGHT, ground_color=_GROUND_LIGHT, intensity=0.5
    )
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        body = int(model.geom_bodyid[geom])
        if is_fixed_body(model, body):
            # The name of mjviser's grid, so that this one replaces it.
            name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, int(geom))
            scene.add_grid(
                f"/fixed_bodies/{get_body_name(model, body)}/{name}",
                infinite_grid=True,
                cell_size=0.5,
                cell_color=_CELL_LINE,
                section_color=_SECTION_LINE,
                section_thickness=1.2,
                plane_color=_GROUND,
                plane_opacity=1.0,
                shadow_opacity=0.35,
                fade_distance=_FADE_DISTANCE,
                position=model.geom_pos[geom],
                wxyz=model.geom_quat[geom],
            )


def set_plain_look(
    server: viser.ViserServer, meshes: Iterable[viser.GlbHandle | viser.BatchedGlbHandle]
) -> None:
    """Replace reflections and shadows by plain light.

    Without a GPU, a browser takes some ten seconds for the first image with reflections, and twice as
    long for every image with shadows.
    """
    scene = server.scene
    scene.configure_environment_map(None)
    scene.configure_default_lights(cast_shadow=False)
    scene.add_light_hemisphere(
        "/sky_light", sky_color=_SKY_LIGHT, ground_color=_GROUND_LIGHT, intensity=_PLAIN_LIGHT
    )
    for mesh in meshes:
        mesh.glb_data = without_metal(mesh.glb_data)


def without_metal(glb: bytes) -> bytes:
    """Return a GLB file with a matte material in place of glTF's default, metal: black without
    reflections."""
    # Header of 12 bytes, then chunks: length, type, content. The first one is JSON.
    end = 20 + int.from_bytes(glb[12:16], "little")
    content: dict[str, Any] = json.loads(glb[20:end])
    materials = content.setdefault("materials", [])
    for mesh in content["meshes"]:
        for part in mesh["primitives"]:
            part.setdefault("material", len(materials))
    materials.append({"pbrMetallicRoughness": {"metallicFactor": 0.0}})
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunk = len(text).to_bytes(4, "little") + b"JSON" + text + glb[end:]
    return glb[:8] + (12 + len(chunk)).to_bytes(4, "little") + chunk


def set_theme(server: viser.ViserServer) -> None:
    """Set the theme of a page's panel."""
    server.gui.configure_theme(
        show_logo=False, show_share_button=False, control_width="medium", brand_color=_BRAND
    )
