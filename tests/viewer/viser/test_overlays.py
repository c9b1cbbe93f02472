"""Overlays of the browser viewer, driven by another viewer."""

from __future__ import annotations

import pytest
from viewer_fakes import FakeEnv

from mjlab.viewer.viser import MjlabViserScene
from mjlab.viewer.viser.overlays import (
    ViserContactOverlays,
    ViserDebugOverlays,
    ViserTermOverlays,
)


@pytest.fixture
def env() -> FakeEnv:
    return FakeEnv(2)


@pytest.fixture
def scene(viser_server, env) -> MjlabViserScene:
    return MjlabViserScene(viser_server, env.sim.mj_model, 2)


def test_plots_restart_with_another_environment(viser_server, env, scene) -> None:
    overlays = ViserTermOverlays(viser_server, env, scene, frame_time=0.02)
    tabs = viser_server.gui.add_tab_group()
    overlays.setup_tabs(tabs)
    assert tabs._tab_labels == ("Rewards", "Metrics")
    for paused in (True, False, False, True):
        overlays.update(paused)
    values = overlays.reward_plotter.history.values
    assert values("upright").tolist() == [0.5, 0.5]
    assert overlays.metrics_plotter.history.values("height").tolist() == [1.0, 1.0]
    scene.env_idx = 1
    overlays.on_env_switch()
    overlays.update(False)
    assert values("upright").tolist() == [1.0]
    overlays.clear_histories()
    assert not len(values("upright"))


def test_the_environment_draws_anew_unless_it_is_switched_off(env, scene) -> None:
    overlays = ViserDebugOverlays(env, scene)
    for _ in range(2):
        overlays.queue()
        scene.update(env.sim)
    spheres = scene._debug_handles["sphere"]
    assert len(spheres.batched_positions) == 2
    overlays.on_env_switch()
    assert not scene._debug_handles
    scene.debug_visualization_enabled = False
    overlays.queue()
    scene.update(env.sim)
    assert not scene._debug_handles


@pytest.mark.parametrize("flag", ["show_contact_points", "show_contact_forces"])
def test_contacts_are_drawn_again_for_another_environment(scene, flag) -> None:
    redraws = []
    scene.set_refresh_handler(lambda: redraws.append(1))
    overlays = ViserContactOverlays(scene)
    overlays.on_env_switch()
    assert not overlays.is_enabled()
    assert not redraws
    setattr(scene, flag, True)
    overlays.on_env_switch()
    assert overlays.is_enabled()
    assert redraws
