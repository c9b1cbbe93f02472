"""The native window's parts that need no window."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from viewer_fakes import FakeEnv, push

from mjlab.viewer import NativeMujocoViewer, RenderingUnavailableError, ViewerConfig
from mjlab.viewer.base import ViewerAction
from mjlab.viewer.history import TermHistory
from mjlab.viewer.native.keys import _ACTIONS, action_of_key
from mjlab.viewer.native.perturbation import MousePush
from mjlab.viewer.native.reward_plots import plot_scale, reward_figures


def test_keys_are_none_that_mujocos_window_uses_itself() -> None:
    strings = [*mujoco.mjVISSTRING, *mujoco.mjRNDSTRING]
    taken = {ord(shortcut) for _, _, shortcut in strings if shortcut}
    taken |= {ord(digit) for digit in "012345"}  # Groups.
    assert not taken & set(_ACTIONS)
    assert action_of_key(ord(" ")) is ViewerAction.TOGGLE_PAUSE
    assert action_of_key(ord("P")) is None


def test_without_a_display_the_error_names_the_browser_viewer(monkeypatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(RenderingUnavailableError, match="--viewer viser"):
        NativeMujocoViewer(FakeEnv(1), push()).run()


def test_the_environment_in_view_wraps_around_and_its_plots_start_anew() -> None:
    viewer = NativeMujocoViewer(FakeEnv(3), push())
    viewer.step_simulation()
    viewer.request_action("prev_env")
    viewer._process_actions()
    assert viewer.env_idx == 2
    assert len(viewer._rewards.values("upright")) == 0
    viewer.request_action("next_env")
    viewer._process_actions()
    assert viewer.env_idx == 0


def test_all_extra_drawing_honours_the_number_of_extra_environments() -> None:
    env = FakeEnv(6, ViewerConfig(max_extra_envs=2))
    viewer = NativeMujocoViewer(env, push())
    scene = mujoco.MjvScene(env.sim.mj_model, maxgeom=1000)
    viewer._load_selected()
    viewer._draw_neighbours(scene)
    assert scene.ngeom == 2 * 2  # Cart and pole of two neighbours.


def test_the_marker_hangs_over_the_followed_body() -> None:
    env = FakeEnv(2)
    env.sim.datas[0].qpos[0] = 1.5
    viewer = NativeMujocoViewer(env, push())
    viewer._load_selected()
    drawn = []
    board = SimpleNamespace(add_arrow=lambda start, end, *_, **__: drawn.append((start, end)))
    viewer._mark_selected(board)
    np.testing.assert_allclose(drawn[0][1], [1.5, 0.0, 1.5])


class TestMousePush:
    """Mouse forces and those that the task applies itself."""

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

    def test_a_push_along_the_rail_is_a_force_on_the_slider_of_that_environment(self) -> None:
        self.data.xfrc_applied[3] = 7.0
        self.push.apply(self.sim, 0, self.data, self.perturb)
        assert self.forces[0, 0] > 0.1
        assert not self.forces[1].any()
        assert (self.data.xfrc_applied[3] == 7.0).all()  # The task's own wrench.

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
    """Curves over the window."""

    def test_the_range_leaves_outliers_out_and_pads_by_a_quarter(self) -> None:
        values = np.linspace(1.0, 2.0, 101)
        values[50] = 900.0
        exponent, low, high = plot_scale(values)
        assert exponent == 0
        assert low == pytest.approx(1.02 - 0.25 * 0.97, abs=0.02)
        assert high == pytest.approx(1.99 + 0.25 * 0.97, abs=0.02)

    @pytest.mark.parametrize(
        ("magnitude", "exponent"), [(0.01, 0), (999.0, 0), (1000.0, 3), (0.004, -3), (0.0, 0)]
    )
    def test_magnitudes_that_read_badly_are_scaled(self, magnitude, exponent) -> None:
        assert plot_scale(np.array([0.0, magnitude]))[0] == exponent

    def test_at_most_twelve_terms_in_two_columns_inside_the_window(self) -> None:
        history = TermHistory(300)
        history.add([(f"term{i}", [float(i)]) for i in range(20)])
        history.add([(f"term{i}", [float("nan")]) for i in range(20)])
        figures = reward_figures(history, mujoco.MjrRect(0, 0, 1000, 600))
        assert len(figures) == 12
        assert {rect.left for rect, _ in figures} == {780, 560}
        assert all(0 <= rect.bottom <= 500 for rect, _ in figures)
        assert figures[0][1].title == "term0"
        assert figures[3][1].linepnt[0] == 1  # NaN is left out.
