"""Sliders that command the robot in view."""

from __future__ import annotations

import pytest
import torch
from page import Page

from mjlab.tasks.velocity.mdp import UniformVelocityCommandCfg
from mjlab.tasks.velocity.mdp.velocity_joystick import VelocityJoystick

RANGES = UniformVelocityCommandCfg.Ranges((-1.5, 2.0), (-1.0, 1.0), (0.0, 0.0))


@pytest.fixture
def page() -> Page:
    return Page()


def make(page: Page, env_idx: int = 1) -> tuple[VelocityJoystick, list[int]]:
    changes: list[int] = []
    joystick = VelocityJoystick("twist", page, RANGES, lambda: env_idx, lambda: changes.append(1))
    return joystick, changes


def test_the_joystick_commands_the_env_in_view(page):
    joystick, _ = make(page)
    command = torch.full((3, 3), 0.25)
    joystick.write_to(command)
    assert (command == 0.25).all()
    page.widgets["Enable"].set_by_person(True)
    page.widgets["Forward (m/s)"].set_by_person(1.5)
    page.widgets["Turn left (rad/s)"].set_by_person(-0.05)
    joystick.write_to(command)
    assert command.tolist()[1] == pytest.approx([1.5, 0.0, -0.05])
    assert (command[[0, 2]] == 0.25).all()


def test_moving_a_slider_takes_the_helm(page):
    joystick, changes = make(page, env_idx=0)
    page.widgets["Forward (m/s)"].set_by_person(0.5)
    assert page.widgets["Enable"].value
    command = torch.zeros(1, 3)
    joystick.write_to(command)
    assert command[0, 0] == 0.5
    assert changes


def test_zero_stops_the_robot(page):
    joystick, _ = make(page, env_idx=0)
    for name, value in (("Forward (m/s)", 0.5), ("Left (m/s)", 0.5), ("Turn left (rad/s)", 0.05)):
        page.widgets[name].set_by_person(value)
    page.widgets["Zero"].set_by_person()
    command = torch.ones(1, 3)
    joystick.write_to(command)
    assert command.tolist() == [[0.0, 0.0, 0.0]]


def test_sliders_reach_the_ends_of_the_range_and_as_far_as_max_says(page):
    make(page)
    forward = page.widgets["Forward (m/s)"]
    assert (forward.min, forward.max) == (-2.0, 2.0)
    # An empty range still gives a slider that can be moved.
    assert page.widgets["Turn left (rad/s)"].max > 0.0
    forward.set_by_person(1.75)
    page.widgets["Max forward (m/s)"].set_by_person(1.0)
    assert (forward.min, forward.max, forward.value) == (-1.0, 1.0, 1.0)


def test_a_view_of_no_environment_commands_none(page):
    joystick, _ = make(page, env_idx=7)
    page.widgets["Enable"].set_by_person(True)
    command = torch.ones(2, 3)
    joystick.write_to(command)
    assert (command == 1.0).all()


def test_who_lets_go_finds_the_command_as_it_went_on_below(page):
    joystick, _ = make(page, env_idx=1)
    command = torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    drawn = command.clone()
    page.widgets["Enable"].set_by_person(True)
    page.widgets["Forward (m/s)"].set_by_person(1.5)
    for _ in range(2):
        joystick.restore(command)
        assert torch.equal(command, drawn)
        command[1, 2] = drawn[1, 2] = 0.7  # As heading control does at every step.
        joystick.write_to(command)
        assert command[1, 0] == 1.5
    page.widgets["Enable"].set_by_person(False)
    joystick.restore(command)
    joystick.write_to(command)
    assert torch.equal(command, drawn)


# Keys.


def command_of(joystick: VelocityJoystick) -> list[float]:
    command = torch.full((1, 3), 9.0)
    joystick.write_to(command)
    return command[0].tolist()


@pytest.mark.parametrize("with_page", [True, False])
def test_keys_change_the_command_in_tenths_of_the_largest(with_page, page):
    joystick = VelocityJoystick("twist", page if with_page else None, RANGES, lambda: 0)
    assert command_of(joystick) == [9.0, 9.0, 9.0]
    for _ in range(3):
        joystick.steer((0.1, 0.0, 0.0))
    joystick.steer((0.0, -0.1, 0.0))
    assert command_of(joystick) == pytest.approx([0.6, -0.1, 0.0])
    for _ in range(20):
        joystick.steer((0.1, 0.0, 0.0))
    assert command_of(joystick)[0] == 2.0
    for _ in range(10):
        joystick.steer((-0.1, 0.0, 0.0))
    assert command_of(joystick)[0] == 0.0


def test_sticks_of_a_gamepad_are_the_command(page):
    joystick, _ = make(page, env_idx=0)
    joystick.steer((0.1, 0.0, 0.0))
    for _ in range(2):
        joystick.steer((-0.5, 1.0, 0.0), add=False)
        assert command_of(joystick) == pytest.approx([-1.0, 1.0, 0.0])


def test_keys_move_the_sliders(page):
    joystick, _ = make(page, env_idx=0)
    page.widgets["Forward (m/s)"].set_by_person(1.0)
    joystick.steer((0.1, 0.0, 0.0))
    assert page.widgets["Forward (m/s)"].value == pytest.approx(1.2)
    assert page.widgets["Enable"].value


def test_stop_halts_the_robot_and_releases_one_that_stands(page):
    joystick, _ = make(page, env_idx=0)
    joystick.steer((0.1, 0.0, 0.1))
    joystick.steer(None)
    assert command_of(joystick) == [0.0, 0.0, 0.0]
    joystick.steer(None)
    assert command_of(joystick) == [9.0, 9.0, 9.0]
    # A robot on its own is stopped, too.
    joystick.steer(None)
    assert command_of(joystick) == [0.0, 0.0, 0.0]
