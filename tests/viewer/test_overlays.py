"""Panels and overlays of the browser viewer, driven as another viewer would."""

from __future__ import annotations

import logging
from types import SimpleNamespace

import numpy as np
import pytest
from viewer_fakes import FakeEnv

from mjlab.viewer.viser import MjlabViserScene, RewardBarPanel, ViserTermPlotter
from mjlab.viewer.viser.overlays import (
    ViserCameraOverlays,
    ViserContactOverlays,
    ViserDebugOverlays,
    ViserTermOverlays,
)


def term(name: str, value: float) -> tuple[str, np.ndarray]:
    return name, np.array([value])


class TestRewardBars:
    """Means over the last second."""

    def test_bars_are_cut_with_a_warning_and_compare_with_the_largest(
        self, viser_server, caplog
    ) -> None:
        with caplog.at_level(logging.WARNING):
            panel = RewardBarPanel(viser_server, ["a", "b<", "c"], 0.02, max_terms=2)
        assert "3 terms" in caplog.text
        panel.update([term("a", 2.0), term("b<", -1.0), term("c", 100.0)])
        assert "width:100.0%" in panel._html.content
        assert "width:50.0%" in panel._html.content
        assert "b&lt;" in panel._html.content

    @pytest.mark.parametrize(("update_dt", "mean"), [(0.1, 94.5), (0.25, 97.5), (3.0, 99.0)])
    def test_the_window_is_a_second(self, viser_server, update_dt, mean) -> None:
        panel = RewardBarPanel(viser_server, ["a"], update_dt)
        for value in range(100):
            panel.update([term("a", value)])
        assert f"{mean:+.4f}" in panel._html.content
        panel.clear_histories()
        panel.refresh()
        assert f"{0.0:+.4f}" in panel._html.content

    def test_it_leaves_nothing_behind(self, viser_server) -> None:
        panel = RewardBarPanel(viser_server, ["a"], 0.1)
        panel.cleanup()
        assert not viser_server.gui._container_handle_from_uuid["root"]._children


class TestTermPlotter:
    """Curves of terms."""

    def test_points_are_recorded_and_shown_up_to_the_length_asked_for(self, viser_server) -> None:
        plotter = ViserTermPlotter(viser_server, ["a", "b"], "Metrics", 3, env_idx=4)
        for value in range(5):
            plotter.update([term("a", value), term("b", -value)])
        for name, sign in (("a", 1), ("b", -1)):
            steps, values = plotter._plots[name].data
            assert steps.tolist() == [-2, -1, 0]
            assert values.tolist() == [sign * 2, sign * 3, sign * 4]
        assert "Metrics terms of environment 4" in plotter._label.content

    def test_another_environment_starts_over(self, viser_server) -> None:
        plotter = ViserTermPlotter(viser_server, ["a"])
        plotter.update([term("a", 1.0)])
        plotter.update_env_idx(2)
        plotter.update([term("a", 5.0)])
        assert plotter._plots["a"].data[1].tolist() == [5.0]
        assert "environment 2" in plotter._label.content

    def test_it_leaves_nothing_behind(self, viser_server) -> None:
        plotter = ViserTermPlotter(viser_server, ["a", "b"])
        plotter.cleanup()
        assert not viser_server.gui._container_handle_from_uuid["root"]._children


@pytest.fixture
def env() -> FakeEnv:
    return FakeEnv(2)


@pytest.fixture
def scene(viser_server, env) -> MjlabViserScene:
    return MjlabViserScene(viser_server, env.sim.mj_model, 2)


def test_terms_are_recorded_while_it_runs_and_start_over_with_another_environment(
    viser_server, env, scene
) -> None:
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


def test_without_metrics_there_is_no_tab_for_them(viser_server, env, scene) -> None:
    env.metrics_manager = SimpleNamespace()
    overlays = ViserTermOverlays(viser_server, env, scene, frame_time=0.02)
    tabs = viser_server.gui.add_tab_group()
    overlays.setup_tabs(tabs)
    assert tabs._tab_labels == ("Rewards",)
    overlays.update(False)
    overlays.cleanup()
    assert overlays.reward_plotter is None


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


def test_an_environment_without_cameras_gets_no_folder(viser_server, env) -> None:
    overlays = ViserCameraOverlays(viser_server, env, env.sim.mj_model)
    assert not overlays.has_cameras
    overlays.setup_controls()
    overlays.update(env.sim.data, 0, np.zeros(3))
    assert overlays.camera_viewers == []
    assert not overlays.has_cameras
    assert not viser_server.gui._container_handle_from_uuid["root"]._children
