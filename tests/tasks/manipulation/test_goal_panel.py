"""Goal panel: drag the goal in the browser."""

from __future__ import annotations

import pytest
import torch
from lifting_stand_ins import ORIGIN_STEP, lifting_command
from page import Page, Widget


class Play:
    """Command with its panel, and the displayed environment."""

    def __init__(self):
        self.env, self.term = lifting_command(difficulty="dynamic")
        self.page, self.view, self.changes = Page(), 1, 0
        self.term.reset(None)
        self.term.create_gui("lift_height", self.page, lambda: self.view, self.changed)
        self.step()

    def changed(self):
        self.changes += 1

    def step(self):
        self.term.compute(0.02)

    @property
    def handle(self) -> Widget:
        # Below the frame that mjviser shifts with the scene.
        return self.page.widgets["/fixed_bodies/lift_height_handle"]

    def goal(self, index: int) -> list[float]:
        """Return a goal from its environment's origin."""
        return (self.term.command[index] - self.env.scene.env_origins[index]).tolist()


@pytest.fixture
def play() -> Play:
    return Play()


def test_the_handle_follows_the_goal_of_the_environment_in_view(play):
    assert play.handle.position == pytest.approx(play.term.command[1].tolist())
    sliders = [play.page.widgets[axis].value for axis in "xyz"]
    assert sliders == pytest.approx(play.goal(1), abs=1e-5)
    play.view = 2
    play.step()
    assert play.handle.position == pytest.approx(play.term.command[2].tolist())
    before = play.term.command.clone()
    play.step()
    assert torch.equal(play.term.command, before)
    assert play.changes == 0


def test_dragging_the_handle_moves_the_goal_of_this_environment_only(play):
    before = play.term.command.clone()
    play.handle.by_person(position=(ORIGIN_STEP + 0.45, -0.1, 0.35))
    play.step()
    assert play.goal(1) == pytest.approx([0.45, -0.1, 0.35], abs=1e-5)
    others = [0, 2, 3]
    assert torch.equal(play.term.command[others], before[others])
    assert play.page.widgets["Hold goal"].value
    assert play.changes == 1
    # The handle is not moved back during a drag.
    assert play.handle.position == (ORIGIN_STEP + 0.45, -0.1, 0.35)


def test_a_goal_that_is_held_is_neither_redrawn_nor_is_the_object_moved(play):
    play.handle.by_person(position=(ORIGIN_STEP + 0.4, 0.0, 0.3))
    play.step()
    pose = play.env.objects["cube"].pose.clone()
    for _ in range(30):
        play.term.compute(0.5)
    assert play.goal(1) == pytest.approx([0.4, 0.0, 0.3], abs=1e-5)
    assert torch.equal(play.env.objects["cube"].pose[1], pose[1])
    # Other environments are unaffected.
    assert not torch.equal(play.env.objects["cube"].pose[0], pose[0])
    play.page.widgets["Hold goal"].by_person(value=False)
    for _ in range(30):
        play.term.compute(0.5)
    assert play.goal(1) != pytest.approx([0.4, 0.0, 0.3], abs=1e-3)


def test_a_goal_that_is_held_stays_through_a_reset(play):
    play.page.widgets["z"].by_person(value=0.33)
    play.step()
    play.term.reset(None)
    play.step()
    assert play.goal(1)[2] == pytest.approx(0.33, abs=1e-5)


def test_sliders_move_goal_and_handle(play):
    play.page.widgets["x"].by_person(value=0.55)
    play.page.widgets["y"].by_person(value=0.1)
    play.page.widgets["z"].by_person(value=0.25)
    play.step()
    assert play.goal(1) == pytest.approx([0.55, 0.1, 0.25], abs=1e-5)
    assert play.handle.position == pytest.approx([ORIGIN_STEP + 0.55, 0.1, 0.25])


def test_handles_end_with_the_sliders(play):
    play.handle.by_person(position=(ORIGIN_STEP + 5.0, 0.0, 0.3))
    play.step()
    # 0.1 m beyond the range of goals.
    assert play.goal(1) == pytest.approx([0.6, 0.0, 0.3], abs=1e-5)
    assert play.handle.position[0] == pytest.approx(ORIGIN_STEP + 0.6)


def test_what_is_held_goes_along_to_another_environment(play):
    play.handle.by_person(position=(ORIGIN_STEP + 0.4, 0.1, 0.3))
    play.step()
    play.view = 3
    play.step()
    assert play.goal(3) == pytest.approx([0.4, 0.1, 0.3], abs=1e-5)
    assert play.handle.position[0] == pytest.approx(3 * ORIGIN_STEP + 0.4)


def test_a_view_of_no_environment_holds_none(play):
    play.view = 17
    before = play.term.command.clone()
    play.page.widgets["Hold goal"].by_person(value=True)
    play.step()
    assert torch.equal(play.term.command, before)
