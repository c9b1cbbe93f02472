"""Pose panel: drag and turn the goal in the browser."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from page import Page, Widget

from mjlab.envs import ManagerBasedRlEnv
from mjlab.envs.mdp import UniformPoseCommand
from mjlab.tasks.registry import load_env_cfg
from mjlab.utils.lab_api.math import quat_error_magnitude

QUAT = (0.5, 0.5, -0.5, 0.5)


class Play:
    """Command with its panel, and the displayed environment."""

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        self.page, self.view, self.changes = Page(), 1, 0
        term = env.command_manager.get_term("hand_pose")
        assert isinstance(term, UniformPoseCommand)
        self.term = term
        term.create_gui("hand_pose", self.page, lambda: self.view, self.changed)  # ty: ignore[invalid-argument-type]
        self.step()

    def changed(self) -> None:
        self.changes += 1

    def step(self) -> None:
        self.term.compute(0.02)

    @property
    def handle(self) -> Widget:
        return self.page.widgets["/fixed_bodies/hand_pose_handle"]

    def goal(self, index: int) -> torch.Tensor:
        """Return a goal in the world, (7,)."""
        return torch.cat(self.term.pose_command_w, dim=1)[index]


@pytest.fixture(scope="module")
def env() -> Iterator[ManagerBasedRlEnv]:
    cfg = load_env_cfg("Mjlab-Reach-Yam")
    cfg.scene.num_envs, cfg.seed = 3, 1
    env = ManagerBasedRlEnv(cfg, device="cpu")
    yield env
    env.close()


@pytest.fixture
def play(env: ManagerBasedRlEnv) -> Play:
    env.reset()
    return Play(env)


def test_the_handle_follows_the_goal_of_the_environment_in_view(play: Play) -> None:
    for play.view in (1, 2):
        play.step()
        assert play.handle.position == pytest.approx(play.goal(play.view)[:3].tolist(), abs=1e-5)
        assert play.handle.wxyz == pytest.approx(play.goal(play.view)[3:].tolist(), abs=1e-5)
    assert play.changes == 0


def test_dragging_the_handle_holds_the_goal_of_this_environment(play: Play) -> None:
    before = play.term.command.clone()
    place = (play.goal(1)[:3] + 0.1).tolist()
    play.handle.by_person(position=tuple(place), wxyz=QUAT)
    play.step()
    assert play.goal(1)[:3].tolist() == pytest.approx(place, abs=1e-5)
    assert quat_error_magnitude(play.goal(1)[3:], torch.tensor(QUAT)) < 1e-3
    # The sign is that of the drawn goals.
    reference = torch.tensor(play.term.export_metadata("hand_pose")["pose_reference_quat"])
    assert (play.term.command[:, 3:] @ reference >= 0.0).all()
    assert torch.equal(play.term.command[[0, 2]], before[[0, 2]])
    assert play.page.widgets["Hold goal"].value
    assert play.changes == 1


def test_a_goal_that_is_held_is_not_resampled(play: Play) -> None:
    play.handle.by_person(position=(0.3, 0.1, 0.4))
    for _ in range(10):
        play.term.compute(1.0)
    assert play.goal(1)[:3].tolist() == pytest.approx([0.3, 0.1, 0.4], abs=1e-5)
    play.page.widgets["Hold goal"].by_person(value=False)
    for _ in range(10):
        play.term.compute(1.0)
    assert play.goal(1)[:3].tolist() != pytest.approx([0.3, 0.1, 0.4], abs=1e-3)


def test_a_view_of_no_environment_holds_none(play: Play) -> None:
    play.view = 17
    before = play.term.command.clone()
    play.page.widgets["Hold goal"].by_person(value=True)
    play.step()
    assert torch.equal(play.term.command, before)
