"""Sky and sunlight of rendered images."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from mjlab.viewer.offscreen_renderer import (
    RenderingUnavailableError,
    has_sky,
    move_sun,
    open_renderer,
    paint_sky,
    prepare_sun,
)

XML = """
<mujoco>
  <visual><rgba haze="0.1 0.2 0.3 1"/></visual>
  {assets}
  <worldbody>
    <light name="sun" type="directional" pos="0 0 2" dir="0 0 -1" diffuse=".8 .8 .8"/>
    <light name="second" type="directional" pos="0 0 9" dir="0 0 -1" diffuse=".6 .6 .6"/>
    <light name="lamp" type="spot" pos="0 0 3" diffuse=".7 .7 .7"/>
    <geom type="box" size="5 5 .1" rgba="1 0 0 1"/>
    <camera name="side" pos="0 -3 1" xyaxes="1 0 0 0 0 1"/>
  </worldbody>
</mujoco>
"""
SKY = '<asset><texture type="skybox" builtin="flat" rgb1="1 1 1" width="8" height="8"/></asset>'


def model(assets: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML.format(assets=assets))


def painted(scene: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return the camera's image, 60 x 60 pixels, before and after painting the sky."""
    data = mujoco.MjData(scene)
    mujoco.mj_forward(scene, data)
    try:
        renderer = open_renderer(scene, 60, 60)
    except RenderingUnavailableError as error:
        pytest.skip(str(error))
    with renderer:
        renderer.update_scene(data, camera="side")
        before = renderer.render()
        after = before.copy()
        paint_sky(after, renderer)
    return before, after


def test_a_model_with_a_sky_keeps_it() -> None:
    assert has_sky(model(SKY))
    assert not has_sky(model())


def test_the_sky_is_painted_where_there_is_nothing_and_meets_the_haze() -> None:
    scene = model()
    before, after = painted(scene)
    ground = before[..., 0] > 0
    assert 0 < ground.sum() < ground.size
    np.testing.assert_array_equal(after[ground], before[ground])
    assert (after[~ground] > 0).all()
    last = np.flatnonzero((~ground).any(axis=1))[-1]
    np.testing.assert_allclose(after[last, 0] / 255, [0.1, 0.2, 0.3], atol=0.01)
    assert after[0, 0].sum() > after[last, 0].sum()


def test_what_is_seen_through_stays_before_the_sky() -> None:
    ghost = '<geom name="ghost" type="sphere" size=".4" pos="0 0 1.6" rgba="0 1 0 .5"/>'
    scene = mujoco.MjModel.from_xml_string(
        XML.format(assets="").replace("<camera", f"{ghost}<camera")
    )
    before, pixels = painted(scene)
    red, green, blue = pixels[18, 30].astype(int)
    # Before painting, the ghost is blended over black.
    assert before[18, 30, 1] > 30
    assert before[18, 30, ::2].max() < 5
    # The ghost is greener than the sky beside it, and the sky shines through.
    assert green - blue > pixels[18, 2].astype(int)[1] - pixels[18, 2].astype(int)[2] + 20
    assert 0 < red < pixels[18, 2, 0]


def test_several_suns_are_as_bright_as_one() -> None:
    scene = model()
    prepare_sun(scene, distance=4.0)
    np.testing.assert_allclose(scene.light_diffuse[:, 0], [0.4, 0.3, 0.7], rtol=1e-6)
    assert scene.light_castshadow.tolist() == [True, False, True]
    assert scene.vis.map.shadowclip * scene.stat.extent == pytest.approx(4.0)


def test_the_sun_follows_the_camera() -> None:
    scene = model()
    data = mujoco.MjData(scene)
    mujoco.mj_forward(scene, data)
    move_sun(scene, data, np.array([10.0, -4.0, 0.5]))
    np.testing.assert_allclose(data.light_xpos[:, :2], [[10, -4], [10, -4], [0, 0]])
    assert data.light_xpos[0, 2] > 0.5
