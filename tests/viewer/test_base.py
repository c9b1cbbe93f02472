"""Loop shared by interactive viewers."""

from __future__ import annotations

import logging
import os
import signal
from types import SimpleNamespace

import pytest
import torch
from viewer_fakes import FakeEnv, push

from mjlab.viewer.base import BaseViewer, Steering, ViewerAction, reset_policy


class ListViewer(BaseViewer):
    """Viewer that records its events in a list."""

    def __init__(self, env, policy, **kwargs):
        super().__init__(env, policy, **kwargs)
        self.events: list[object] = []
        self.open = False
        self.fail_display = False

    def setup(self) -> None:
        self.open = True

    def is_running(self) -> bool:
        return self.open

    def sync_env_to_viewer(self) -> None:
        if self.fail_display:
            raise ValueError("cannot draw")
        self.events.append("frame")

    def sync_viewer_to_env(self) -> None:
        pass

    def close(self) -> None:
        self.open = False
        self.events.append("close")

    def after_env_step(self) -> None:
        self.events.append("step")

    def on_paused(self, paused: bool) -> None:
        self.events.append("pause" if paused else "resume")

    def handle_action(self, action, payload) -> bool:
        self.events.append((action, payload))
        return action is not ViewerAction.PREV_ENV


@pytest.fixture
def viewer() -> ListViewer:
    viewer = ListViewer(FakeEnv(1), push())
    viewer.increase_speed()
    viewer.increase_speed()
    viewer.increase_speed()
    return viewer


def test_run_takes_exactly_the_steps_asked_for_and_closes(viewer) -> None:
    viewer.run(num_steps=7)
    assert viewer.env.num_steps == 7
    assert viewer.events.count("step") == 7
    assert viewer.events[-1] == "close"
    assert viewer.get_status().step_count == 7


def test_the_policy_sees_observations_and_no_gradients_are_kept(viewer) -> None:
    seen = []

    def policy(obs):
        seen.append((obs.shape, torch.is_grad_enabled()))
        return torch.zeros(1, 1)

    viewer.policy = policy
    viewer.run(num_steps=1)
    assert seen == [((1, 2), False)]


def test_an_error_in_a_step_pauses_and_is_shown_and_resuming_clears_it(viewer, caplog) -> None:
    viewer.env.fail_at = {1}
    with caplog.at_level(logging.ERROR):
        assert not viewer.step_simulation()
    status = viewer.get_status()
    assert status.paused
    assert status.last_error == "RuntimeError: step 1 failed"
    assert "Traceback" in caplog.text
    viewer.resume()
    assert viewer.get_status().last_error is None
    assert viewer.step_simulation()


def test_a_failing_display_is_logged_once(viewer, caplog) -> None:
    viewer.fail_display = True
    with caplog.at_level(logging.ERROR):
        for _ in range(5):
            viewer._next_frame = 0.0
            viewer.tick()
    assert caplog.text.count("Traceback") == 1
    assert viewer.get_status().last_error == "ValueError: cannot draw"


def test_single_steps_count_only_while_paused(viewer) -> None:
    viewer._last_tick = float("inf")  # Stop time, so that only the actions step.
    viewer.request_single_step()
    viewer._process_actions()
    assert viewer.env.num_steps == 0
    viewer.request_toggle_pause()
    viewer.request_single_step()
    viewer._process_actions()
    assert viewer.env.num_steps == 1


def test_steering_reaches_the_commands_of_the_env_in_view(viewer) -> None:
    for direction in (Steering.FORWARD, Steering.TURN_RIGHT, Steering.STOP):
        viewer.request_action("steer", direction)
    viewer._process_actions()
    assert viewer.env.command_manager.steered == [
        (0, (0.1, 0.0, 0.0)),
        (0, (0.0, 0.0, -0.1)),
        (0, None),
    ]


def test_the_right_arrow_steps_a_paused_simulation(viewer) -> None:
    viewer.request_toggle_pause()
    viewer.request_action("steer", Steering.TURN_RIGHT)
    viewer.request_action("steer", Steering.TURN_LEFT)
    viewer._process_actions()
    assert viewer.env.num_steps == 1
    assert viewer.env.command_manager.steered == [(0, (0.0, 0.0, 0.1))]


def test_reset_also_resets_a_policy_with_memory(viewer) -> None:
    class Recurrent:
        resets = 0

        def __call__(self, obs):
            return torch.zeros(len(obs), 1)

        def reset(self):
            self.resets += 1

    viewer.policy = Recurrent()
    viewer.step_simulation()
    viewer.request_reset()
    viewer._process_actions()
    assert viewer.env.num_resets == 1
    assert viewer.policy.resets == 1
    assert viewer.get_status().step_count == 0


def test_a_policy_with_memory_forgets_what_ended(viewer) -> None:
    seen = []

    class Recurrent:
        def __call__(self, obs):
            return torch.zeros(len(obs), 1)

        def reset(self, dones=None):
            seen.append(dones)

    viewer.policy = Recurrent()
    dones = torch.tensor([1])
    viewer.env.step = lambda actions: (None, None, dones, {})
    viewer.step_simulation()
    assert seen == [dones]
    # Environment without a wrapper.
    viewer.env.step = lambda actions: (None, None, dones == 0, dones == 1, {})
    viewer.step_simulation()
    assert seen[1].tolist() == [True]


@pytest.mark.parametrize("reset", [lambda: 1 / 0, lambda env_ids=None: 1 / 0, iter, None])
def test_policies_that_know_nothing_of_ends_are_left_alone(reset) -> None:
    reset_policy(SimpleNamespace(reset=reset), torch.tensor([1]))


def test_a_reset_that_fails_is_shown_and_ends_nothing(viewer) -> None:
    viewer.env.reset = lambda: 1 / 0
    viewer.request_reset()
    viewer.tick()
    assert "ZeroDivisionError" in viewer.get_status().last_error


def test_names_that_are_no_action_become_custom_with_their_payload(viewer) -> None:
    viewer.request_action("fetch_checkpoint", "model_3.pt")
    viewer.request_action("dance", {"steps": 3})
    viewer.request_action("PREV_ENV")
    viewer._process_actions()
    assert viewer.events == [
        (ViewerAction.FETCH_CHECKPOINT, "model_3.pt"),
        (ViewerAction.CUSTOM, {"steps": 3}),
        (ViewerAction.PREV_ENV, None),
    ]


def test_pausing_twice_says_so_once(viewer) -> None:
    viewer.pause()
    viewer.pause()
    viewer.toggle_pause()
    assert viewer.events == ["pause", "resume"]
    assert viewer.actual_realtime >= 0.0


def test_the_first_interrupt_ends_the_loop_and_the_old_handler_comes_back(viewer) -> None:
    before = signal.getsignal(signal.SIGINT)
    viewer.after_env_step = lambda: os.kill(os.getpid(), signal.SIGINT)
    # Let the viewer lag, so that several steps are due at the interrupt. A further step would send
    # a second interrupt and end the program.
    viewer._pacer.add(1.0)
    viewer.run(num_steps=1000)
    assert viewer.env.num_steps == 1
    assert not viewer.open
    assert signal.getsignal(signal.SIGINT) is before


def test_a_subclass_adds_statistics_every_tick() -> None:
    class Viewer(ListViewer):
        def _update_stats(self) -> None:
            super()._update_stats()
            self.events.append("stats")

    viewer = Viewer(FakeEnv(1), push())
    viewer.tick()
    viewer.toggle_pause()
    viewer.tick()
    assert viewer.events.count("stats") == 2


def test_a_subclass_offers_other_speeds() -> None:
    class Viewer(ListViewer):
        SPEED_MULTIPLIERS = [0.1, 0.9, 20.0]

    viewer = Viewer(FakeEnv(1), push())
    assert viewer.target_realtime == 0.9
    viewer.increase_speed()
    viewer.increase_speed()
    assert viewer.get_status().speed_multiplier == 20.0
    viewer.reset_speed()
    assert viewer.target_realtime == 0.9
    assert [2.0**n for n in range(-5, 4)] == BaseViewer.SPEED_MULTIPLIERS
