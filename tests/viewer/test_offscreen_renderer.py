"""Offscreen rendering."""

from __future__ import annotations

import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest
import torch
from viewer_fakes import FakeEnv

from mjlab.utils.errors import UnknownNameError
from mjlab.viewer import OffscreenRenderer, RenderingUnavailableError, ViewerConfig
from mjlab.viewer.offscreen_renderer import open_renderer
from mjlab.viewer.viewer_config import OriginType


def make(env: FakeEnv, **fields) -> OffscreenRenderer:
    cfg = ViewerConfig(width=96, height=64, **fields)
    return OffscreenRenderer(
        env.sim.mj_model, cfg, env.scene, env.sim.model, env.sim.expanded_fields
    )


def picture(env: FakeEnv, camera=None, debug_vis=None, **fields) -> np.ndarray:
    renderer = make(env, **fields)
    renderer.initialize()
    try:
        renderer.update(env.sim, debug_vis, camera)
        return renderer.render().astype(int)
    finally:
        renderer.close()


def differs(a: np.ndarray, b: np.ndarray) -> bool:
    return bool((np.abs(a - b).max(axis=-1) > 20).sum() > 10)


def test_wrong_order_of_calls_raises_with_what_to_do(monkeypatch) -> None:
    renderer = make(FakeEnv(1))
    with pytest.raises(RuntimeError, match=r"call initialize\(\) first"):
        renderer.render()
    with pytest.raises(RuntimeError, match=r"call initialize\(\) first"):
        renderer.update(None)
    renderer._renderer = object()
    with pytest.raises(RuntimeError, match=r"call close\(\) first"):
        renderer.initialize()


@pytest.mark.parametrize(
    ("fields", "message"),
    [({"max_extra_envs": -1}, "max_extra_envs.*-1"), ({"entity_name": "x"}, "entity_name.*'x'")],
)
def test_bad_configurations_raise_before_any_drawing(fields, message) -> None:
    with pytest.raises(ValueError, match=message):
        make(FakeEnv(1), origin_type=OriginType.ASSET_ROOT, **fields)


@pytest.mark.parametrize(
    "failure",
    [
        ImportError("Cannot initialize a EGL device display."),
        AttributeError("'NoneType' object has no attribute 'eglQueryString'"),
        mujoco.FatalError("an OpenGL platform library has not been loaded"),
    ],
)
def test_missing_renderers_name_what_to_install(monkeypatch, failure) -> None:
    def fail(*_, **__):
        raise failure

    monkeypatch.setattr(mujoco, "Renderer", fail)
    with pytest.raises(RenderingUnavailableError, match="libegl1") as caught:
        make(FakeEnv(1)).initialize()
    assert "MUJOCO_GL=osmesa" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_egl_is_called_so_and_what_to_install_is_named(monkeypatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    noise = AttributeError("'NoneType' object has no attribute 'eglQueryString'")
    text = str(RenderingUnavailableError.offscreen(noise))
    assert "(MUJOCO_GL=unset): no EGL library or driver was found. " in text
    assert "NoneType" not in text
    assert "apt-get install libegl1 libgl1 libgl1-mesa-dri" in text


def test_the_scenes_own_model_is_left_alone() -> None:
    env = FakeEnv(1)
    before = (env.sim.mj_model.stat.extent, env.sim.mj_model.vis.global_.fovy)
    renderer = make(env, distance=10.0, fovy=20.0)
    assert (env.sim.mj_model.stat.extent, env.sim.mj_model.vis.global_.fovy) == before
    assert renderer._model.stat.extent == 15.0
    assert renderer._model.vis.global_.fovy == 20.0


@pytest.mark.usefixtures("gl")
@pytest.mark.parametrize("chosen_first", [None, pytest.param("disable", marks=pytest.mark.slow)])
def test_it_renders_without_a_display(
    chosen_first,
) -> None:
    code = (
        "import os, mujoco\n"
        "os.environ.pop('MUJOCO_GL', None)\n"
        "from mjlab.viewer.offscreen_renderer import open_renderer\n"
        "open_renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).close()"
    )
    without = ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")
    environ = {name: value for name, value in os.environ.items() if name not in without}
    if chosen_first is not None:
        environ["MUJOCO_GL"] = chosen_first
    subprocess.run([sys.executable, "-c", code], check=True, env=environ)


@pytest.mark.usefixtures("gl")
def test_an_image_larger_than_the_machine_can_render_is_reported() -> None:
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    model.vis.global_.offwidth = 100_000
    with pytest.raises(RenderingUnavailableError, match="100000 x 64 pixels") as caught:
        open_renderer(model, 64, 100_000)
    assert "limit is" in str(caught.value)
    assert "--video-width" in str(caught.value)
    assert "install" not in str(caught.value)


@pytest.mark.usefixtures("gl")
class TestPictures:
    """Content of the images."""

    def test_an_image_has_the_size_asked_for_and_shows_the_robot(self) -> None:
        image = picture(FakeEnv(1), elevation=-15.0, distance=3.0)
        assert image.shape == (64, 96, 3)
        red = (image[..., 0] > 1.5 * image[..., 2]) & (image[..., 0] > 60)
        assert red[16:48, 32:64].sum() > 30  # The followed cart.

    def test_the_camera_follows_the_body(self) -> None:
        env = FakeEnv(1)
        env.sim.datas[0].qpos[0] = 30.0
        env.sim.forward()
        image = picture(env, elevation=-15.0, distance=3.0)
        assert ((image[..., 0] > 1.5 * image[..., 2]) & (image[..., 0] > 60)).sum() > 30

    def test_a_model_camera_can_be_used_by_name_or_number(self) -> None:
        env = FakeEnv(1)
        side = picture(env, camera="side")
        assert differs(side, picture(env))
        assert not differs(side, picture(env, camera=0))
        for unknown in ("top", 1, -1):
            with pytest.raises(UnknownNameError, match=rf"'{unknown}'.*\['side'\]"):
                picture(env, camera=unknown)

    def test_neighbors_are_drawn_with_their_own_state(self) -> None:
        env = FakeEnv(2)
        env.sim.datas[1].qpos[0] = -1.0
        env.sim.forward()
        assert differs(picture(env, max_extra_envs=1), picture(env, max_extra_envs=0))

    def test_an_environment_that_does_not_exist_is_clamped(self) -> None:
        env = FakeEnv(2)
        last = picture(env, env_idx=1, max_extra_envs=0)
        assert not differs(last, picture(env, env_idx=99, max_extra_envs=0))

    def test_randomized_colors_are_drawn_although_expanded_after_construction(self) -> None:
        env = FakeEnv(1)
        plain = picture(env, distance=3.0)
        renderer = make(env, distance=3.0)
        rgba = torch.as_tensor(env.sim.mj_model.geom_rgba).clone()[None]
        rgba[0, 1] = torch.tensor([0.0, 1.0, 0.0, 1.0])
        env.sim.expanded_fields = {"geom_rgba"}
        env.sim.model.geom_rgba = rgba
        renderer.initialize()
        renderer.update(env.sim)
        assert differs(plain, renderer.render().astype(int))
        renderer.close()

    def test_debug_drawings_appear(self) -> None:
        env = FakeEnv(1)
        drawn = picture(env, debug_vis=env.update_visualizers, distance=2.0)
        assert differs(drawn, picture(env, distance=2.0))

    def test_geom_groups_can_be_hidden(self) -> None:
        env = FakeEnv(1)
        hidden = picture(env, geom_group=(0, 0, 0, 0, 0, 0))
        assert differs(hidden, picture(env))

    def test_it_can_be_closed_twice_and_opened_again(self) -> None:
        renderer = make(FakeEnv(1))
        renderer.initialize()
        renderer.close()
        renderer.close()
        renderer.initialize()
        renderer.close()
