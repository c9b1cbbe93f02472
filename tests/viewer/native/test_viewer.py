"""Native viewer, without a window."""

from __future__ import annotations

import contextlib
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from viewer_fakes import FakeEnv, push

from mjlab.viewer import NativeMujocoViewer, RenderingUnavailableError, ViewerConfig
from mjlab.viewer.base import TermHistory, ViewerAction
from mjlab.viewer.native import keys
from mjlab.viewer.native.keys import ACTIONS
from mjlab.viewer.native.viewer import (
    MousePush,
    PlotCfg,
    compute_viewports,
    plot_scale,
    reward_figures,
)


def test_keys_are_none_that_mujocos_window_uses_itself() -> None:
    strings = [*mujoco.mjVISSTRING, *mujoco.mjRNDSTRING]
    taken = {ord(shortcut) for _, _, shortcut in strings if shortcut}
    taken |= {ord(digit) for digit in "012345"}  # Groups.
    assert not taken & set(ACTIONS)
    assert ACTIONS.get(ord(" ")) is ViewerAction.TOGGLE_PAUSE
    assert ACTIONS.get(ord("P")) is None


def test_keys_steer_the_environment_in_view() -> None:
    viewer = NativeMujocoViewer(FakeEnv(3), push())
    viewer.select_env(2)
    for code in (keys.KEY_UP, keys.KEY_DELETE, keys.KEY_END, ord("P")):
        viewer._on_key(code)
    viewer._process_actions()
    steered = viewer.env.command_manager.steered
    assert steered == [(2, (0.1, 0.0, 0.0)), (2, (0.0, 0.1, 0.0)), (2, None)]


def test_the_help_lists_each_key() -> None:
    named = {name[4:]: code for name, code in vars(keys).items() if name.startswith("KEY_")}
    listed = set()
    for words, _ in (*keys.KEY_HELP, *keys.STEERING_HELP):
        for word in words.removesuffix(", paused").split(" / "):
            listed.add(named[word.upper().replace(" ", "_")])
    # Further keys of the window.
    assert listed | {keys.KEY_MINUS, keys.KEY_EQUAL, keys.KEY_F9} == set(ACTIONS)


def test_without_a_display_the_error_names_the_browser_viewer(monkeypatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(RenderingUnavailableError, match="--viewer viser"):
        NativeMujocoViewer(FakeEnv(1), push()).run()


def test_the_environment_in_view_wraps_around_and_clears_its_plots() -> None:
    viewer = NativeMujocoViewer(FakeEnv(3), push())
    viewer.step_simulation()
    viewer.request_action("prev_env")
    viewer._process_actions()
    assert viewer.env_idx == 2
    assert len(viewer._rewards.values("upright")) == 0
    viewer.request_action("next_env")
    viewer._process_actions()
    assert viewer.env_idx == 0


def test_all_extra_drawing_honors_the_number_of_extra_environments() -> None:
    env = FakeEnv(6, ViewerConfig(max_extra_envs=2))
    viewer = NativeMujocoViewer(env, push())
    scene = mujoco.MjvScene(env.sim.mj_model, maxgeom=1000)
    viewer._load_selected()
    viewer._draw_neighbors(scene)
    assert scene.ngeom == 1 + 2 * 2  # Marker, and cart and pole of two neighbors.


def test_the_marker_hangs_over_the_followed_body() -> None:
    env = FakeEnv(2)
    env.sim.datas[0].qpos[0] = 1.5
    viewer = NativeMujocoViewer(env, push())
    viewer._load_selected()
    drawn = []
    board = SimpleNamespace(add_arrow=lambda start, end, *_, **__: drawn.append((start, end)))
    viewer._visualizer_of = lambda scn: board
    viewer._draw_neighbors(mujoco.MjvScene(env.sim.mj_model, maxgeom=100))
    np.testing.assert_allclose(drawn[0][1], [1.5, 0.0, 1.5])


def test_key_codes_are_those_of_glfw() -> None:
    import glfw

    ours = {name: code for name, code in vars(keys).items() if name.startswith("KEY_")}
    assert len(ours) > 100
    for name, code in ours.items():
        if name != "KEY_HELP":
            assert code == getattr(glfw, name), name


class TestDebugDrawing:
    """Hooks for subclasses: `_update_debug_visualizers` and `_show_debug_vis`."""

    @pytest.fixture(autouse=True)
    def _setup(self) -> None:
        self.env = FakeEnv(1)
        model = self.env.sim.mj_model
        self.handle = SimpleNamespace(
            user_scn=mujoco.MjvScene(model, maxgeom=100),
            lock=contextlib.nullcontext,
            is_running=lambda: True,
            set_texts=lambda texts: None,
            sync=lambda: None,
        )

    def show(self, viewer: NativeMujocoViewer) -> int:
        viewer._handle = self.handle
        viewer.sync_env_to_viewer()
        return self.handle.user_scn.ngeom

    def test_a_subclass_draws_more_in_every_frame(self) -> None:
        class Viewer(NativeMujocoViewer):
            def _update_debug_visualizers(self, viewer) -> None:
                super()._update_debug_visualizers(viewer)
                mujoco.mjv_initGeom(
                    viewer.user_scn.geoms[viewer.user_scn.ngeom],
                    mujoco.mjtGeom.mjGEOM_SPHERE, np.ones(3), np.zeros(3), np.eye(3).ravel(),
                    np.ones(4, np.float32),
                )  # fmt: skip
                viewer.user_scn.ngeom += 1

        plain = self.show(NativeMujocoViewer(self.env, push()))
        extended = Viewer(self.env, push())
        assert [self.show(extended), self.show(extended)] == [plain + 1, plain + 1]

    def test_switched_off_nothing_is_drawn(self) -> None:
        viewer = NativeMujocoViewer(self.env, push())
        assert viewer._show_debug_vis
        assert self.show(viewer) > 0
        viewer.request_action("toggle_debug_vis")
        viewer._process_actions()
        assert not viewer._show_debug_vis
        assert self.show(viewer) == 0

    def test_the_camera_follows_the_bodys_origin_if_centers_of_mass_differ(self) -> None:
        self.env.cfg.viewer = ViewerConfig(
            origin_type=ViewerConfig.OriginType.ASSET_ROOT, entity_name="cartpole"
        )
        self.handle.cam = mujoco.MjvCamera()
        self.env.sim.expand("body_mass", torch.ones(1, self.env.sim.mj_model.nbody))
        self.env.sim.datas[0].qpos[0] = 0.7
        viewer = NativeMujocoViewer(self.env, push())
        self.show(viewer)
        np.testing.assert_allclose(self.handle.cam.lookat, [0.7, 0.0, 1.0])


def test_the_model_and_the_state_in_view_are_there_for_subclasses() -> None:
    env = FakeEnv(2)
    env.sim.expand("geom_rgba", torch.rand(2, env.sim.mj_model.ngeom, 4))
    env.sim.datas[1].qpos[0] = 0.5
    viewer = NativeMujocoViewer(env, push())
    viewer.select_env(1)
    viewer._load_selected()
    np.testing.assert_allclose(viewer.mjm.geom_rgba, env.sim.model.geom_rgba[1])
    assert viewer.mjd.qpos[0] == pytest.approx(0.5)


class TestMousePush:
    """Mouse forces combined with forces of the task."""

    @pytest.fixture(autouse=True)
    def _setup(self) -> None:
        self.env = FakeEnv(2)
        self.model = self.env.sim.mj_model
        self.data = self.env.sim.datas[0]
        self.forces = torch.zeros(2, self.model.nv)
        self.sim = SimpleNamespace(data=SimpleNamespace(qfrc_applied=self.forces))
        self.push = MousePush(self.model)
        self.perturb = mujoco.MjvPerturb()
        self.perturb.select = self.model.body("cartpole/cart").id
        self.perturb.active = int(mujoco.mjtPertBit.mjPERT_TRANSLATE)
        self.perturb.localmass = 1.0
        self.perturb.scale = 1.0
        self.perturb.refselpos[:] = self.data.xpos[self.perturb.select] + [1.0, 0.0, 0.0]
        self.perturb.refpos[:] = self.perturb.refselpos

    def test_pushes_are_forces_on_the_slider(self) -> None:
        self.data.xfrc_applied[3] = 7.0
        self.push.apply(self.sim, 0, self.data, self.perturb)
        assert self.forces[0, 0] > 0.1
        assert not self.forces[1].any()
        assert (self.data.xfrc_applied[3] == 7.0).all()  # Wrench of the task.

    def test_the_tasks_own_force_is_added_to_and_comes_back_when_the_push_ends(self) -> None:
        self.forces[0] = torch.tensor([2.0, -3.0])
        for _ in range(3):
            self.push.apply(self.sim, 0, self.data, self.perturb)
        pushed = self.forces[0, 0].item()
        self.perturb.active = 0
        self.push.apply(self.sim, 0, self.data, self.perturb)
        assert pushed > 2.0
        assert self.forces[0].tolist() == [2.0, -3.0]

    def test_switching_the_environment_takes_the_force_of_the_old_one_back(self) -> None:
        self.push.apply(self.sim, 0, self.data, self.perturb)
        self.push.apply(self.sim, 1, self.data, self.perturb)
        assert not self.forces[0].any()
        assert self.forces[1, 0] > 0.1
        self.push.release(self.sim)
        assert not self.forces.any()

    def test_what_a_reset_wrote_is_not_overwritten_when_the_push_ends(self) -> None:
        self.push.apply(self.sim, 0, self.data, self.perturb)
        self.forces[0] = torch.tensor([0.0, 1.0])
        self.push.release(self.sim)
        assert self.forces[0].tolist() == [0.0, 1.0]


class TestRewardPlots:
    """Reward plots in the window."""

    def test_the_range_leaves_outliers_out_and_pads_by_a_quarter(self) -> None:
        values = np.linspace(1.0, 2.0, 101)
        values[50] = 900.0
        exponent, low, high = plot_scale(values, PlotCfg())
        assert exponent == 0
        assert low == pytest.approx(1.02 - 0.25 * 0.97, abs=0.02)
        assert high == pytest.approx(1.99 + 0.25 * 0.97, abs=0.02)

    def test_at_most_twelve_terms_in_two_columns_inside_the_window(self) -> None:
        history = TermHistory(300)
        history.add([(f"term{i}", [float(i)]) for i in range(20)])
        history.add([(f"term{i}", [float("nan")]) for i in range(20)])
        figures = reward_figures(history, mujoco.MjrRect(0, 0, 1200, 600), PlotCfg())
        assert len(figures) == 12
        assert {rect.left for rect, _ in figures} == {1000, 800}
        assert all(0 <= rect.bottom <= 500 for rect, _ in figures)
        assert figures[0][1].title == "term0"
        assert figures[3][1].linepnt[0] == 1  # NaN is left out.

    @pytest.mark.parametrize("num_plots", [0, 1, 5, 7, 12, 30])
    @pytest.mark.parametrize("changes", [{}, {"max_viewports": 20, "max_rows_per_col": 5}])
    def test_plots_fill_their_strip_without_overlap(self, num_plots, changes) -> None:
        cfg = PlotCfg(**changes)
        rect = mujoco.MjrRect(10, 20, 1200, 900)
        places = compute_viewports(num_plots, rect, cfg)
        assert len(places) == min(num_plots, cfg.max_viewports)
        corners = {(place.left, place.bottom) for place in places}
        assert len(corners) == len(places)
        for place in places:
            assert place.left >= 10 + 1200 * (1 - cfg.plot_strip_fraction) - 1
            assert place.left + place.width <= 1210
            assert place.bottom >= 20
            assert place.bottom + place.height <= 920
            assert place.height <= 900 // cfg.min_rows_per_col
        if num_plots:
            assert places[0].left + places[0].width == 1210
            assert places[0].bottom + places[0].height == 920

    def test_the_viewer_plots_what_its_config_asks_for(self) -> None:
        cfg = PlotCfg(history=5, max_viewports=1, background_alpha=0.2, grid_size=(2, 6))
        viewer = NativeMujocoViewer(FakeEnv(1), push(), 60.0, None, cfg)
        for _ in range(8):
            viewer.step_simulation()
        shown = []
        viewer._handle = SimpleNamespace(
            user_scn=mujoco.MjvScene(viewer.mjm, maxgeom=100), lock=contextlib.nullcontext,
            is_running=lambda: True, set_texts=lambda texts: None, sync=lambda: None,
            viewport=mujoco.MjrRect(0, 0, 600, 400), set_figures=shown.extend,
        )  # fmt: skip
        viewer._show_plots = True
        viewer.sync_env_to_viewer()
        [(_, figure)] = shown
        assert figure.linepnt[0] == 5
        assert list(figure.gridsize) == [2, 6]
        assert figure.figurergba[3] == pytest.approx(0.2)
