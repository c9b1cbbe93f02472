"""Foot rewards against values known by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from stand_ins import StandInEnv, contacts

from mjlab.managers import RewardTermCfg, SceneEntityCfg
from mjlab.tasks.velocity import mdp

FEET = SceneEntityCfg("robot", site_names=("left", "right"), site_ids=[0, 2])
LANDED = torch.tensor([[True, False], [False, True]])


def heights(*rows: tuple[float, float]) -> Any:
    return SimpleNamespace(data=SimpleNamespace(heights=torch.tensor(rows)))


def walking(**sensors: Any) -> Any:
    """Return two environments, moving and standing. The middle site is not a foot."""
    env: Any = StandInEnv(**sensors).command((0.4, 0.3, -0.1), (0.0, 0.0, 0.04))
    env.data.site_lin_vel_w = torch.tensor(
        [[[0.3, 0.4, 9.0], [7, 7, 7], [0.0, -2.0, 9.0]], [[1.0, 0.0, 0.0], [7, 7, 7], [0, 0, 1.0]]]
    )
    return env


def logged(env: Any, name: str) -> float:
    return env.extras["log"][f"Metrics/{name}"].item()


# Air time.


def test_feet_are_rewarded_while_their_air_time_is_between_the_thresholds():
    air = torch.tensor([[0.05, 0.051, 0.3], [0.499, 0.5, 0.0]])
    env: Any = StandInEnv(feet=contacts(current_air_time=air))
    assert mdp.feet_air_time(env, "feet").tolist() == [2.0, 1.0]
    assert logged(env, "air_time_mean") == pytest.approx((0.05 + 0.051 + 0.3 + 0.499 + 0.5) / 5)


def test_air_time_counts_only_where_motion_is_commanded():
    air = torch.full((2, 4), 0.2)
    env: Any = StandInEnv(feet=contacts(current_air_time=air))
    env.command((0.3, 0.0, 0.2), (0.3, 0.0, -0.21))
    # Half is not above one half.
    assert mdp.feet_air_time(env, "feet", command_name="twist").tolist() == [0.0, 4.0]


def test_with_all_feet_on_the_ground_the_mean_air_time_is_zero():
    env: Any = StandInEnv(feet=contacts(current_air_time=torch.zeros(2, 4)))
    mdp.feet_air_time(env, "feet")
    assert logged(env, "air_time_mean") == 0.0


# Clearance and slip.


def test_clearance_weighs_the_miss_of_the_target_by_the_speed_of_the_foot():
    env = walking(scan=heights((0.02, 0.15), (0.0, 0.0)))
    cost = mdp.feet_clearance(env, 0.1, "scan", asset_cfg=FEET)
    assert cost.tolist() == pytest.approx([0.08 * 0.5 + 0.05 * 2.0, 0.1 * 1.0])
    params = {"command_name": "twist", "command_threshold": 0.05, "asset_cfg": FEET}
    cost = mdp.feet_clearance(env, 0.1, "scan", **params)
    assert cost.tolist() == pytest.approx([0.08 * 0.5 + 0.05 * 2.0, 0.0])


def test_slip_is_the_squared_speed_of_feet_in_contact():
    env = walking(feet=contacts(found=torch.tensor([[2.0, 0.0], [1.0, 1.0]])))
    cost = mdp.feet_slip(env, "feet", "twist", command_threshold=0.05, asset_cfg=FEET)
    assert cost.tolist() == pytest.approx([0.25, 0.0])
    assert logged(env, "slip_velocity_mean") == pytest.approx((0.5 + 1.0 + 0.0) / 3)
    cost = mdp.feet_slip(env, "feet", "twist", asset_cfg=FEET)
    assert cost.tolist() == pytest.approx([0.25, 1.0])
    # The live view of the simulation is unchanged.
    assert env.data.site_lin_vel_w[0, 0, 1] == pytest.approx(0.4)


# Landing.


def test_a_landing_costs_the_force_of_the_ground():
    force = torch.tensor([[[3.0, 4.0, 0.0], [100.0, 0, 0]], [[100.0, 0, 0], [0, 0, -7.0]]])
    env: Any = StandInEnv(feet=contacts(force=force, landed=LANDED))
    env.command((1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert mdp.soft_landing(env, "feet").tolist() == [5.0, 7.0]
    assert logged(env, "landing_force_mean") == 6.0
    assert mdp.soft_landing(env, "feet", command_name="twist").tolist() == [5.0, 0.0]


# Swing height.


class Swings:
    """The term, with contacts and heights that a test sets step by step."""

    def __init__(self) -> None:
        self.contact = contacts(found=torch.ones(2, 2), landed=torch.zeros(2, 2).bool())
        self.scan = heights((0.0, 0.0), (0.0, 0.0))
        self.env: Any = StandInEnv(feet=self.contact, scan=self.scan)
        self.env.command((1.0, 0.0, 0.0), (1.0, 0.0, 0.0))
        self.params = {
            "sensor_name": "feet",
            "height_sensor_name": "scan",
            "target_height": 0.1,
            "command_name": "twist",
            "command_threshold": 0.05,
        }
        cfg = RewardTermCfg(func=mdp.feet_swing_height, weight=1.0, params=self.params)
        self.term = mdp.feet_swing_height(cfg, self.env)

    def step(self, height: float, found: float, landed: bool = False) -> list[float]:
        self.scan.data.heights = torch.full((2, 2), height)
        self.contact.data.found = torch.tensor([[found, 1.0], [found, 1.0]])
        self.contact.compute_first_contact = lambda dt: torch.tensor([[landed, False]] * 2)
        return self.term(self.env, **self.params).tolist()


@pytest.fixture
def swings() -> Swings:
    return Swings()


def test_a_swing_costs_how_far_its_peak_was_from_the_target_when_it_lands(swings):
    for height in (0.03, 0.07, 0.05):
        assert swings.step(height, found=0.0) == [0.0, 0.0]
    # Heights on the ground do not count as part of the swing.
    assert swings.step(0.2, found=1.0, landed=True) == pytest.approx([0.09, 0.09], abs=1e-6)
    assert logged(swings.env, "peak_height_mean") == pytest.approx(0.07)
    # The next swing starts from nothing.
    swings.step(0.1, found=0.0)
    assert swings.step(0.0, found=1.0, landed=True) == pytest.approx([0.0, 0.0], abs=1e-6)


def test_a_landing_costs_nothing_where_no_motion_is_commanded(swings):
    swings.env.command((1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    swings.step(0.05, found=0.0)
    assert swings.step(0.0, found=1.0, landed=True) == pytest.approx([0.25, 0.0], abs=1e-6)
    # The landing still clears the peaks.
    assert (swings.term.peak_heights == 0.0).all()


def test_the_peak_of_one_episode_is_not_charged_to_the_next(swings):
    swings.step(0.5, found=0.0)
    swings.term.reset(torch.tensor([1]))
    swings.step(0.1, found=0.0)
    assert swings.step(0.0, found=1.0, landed=True) == pytest.approx([16.0, 0.0], abs=1e-5)


def test_the_peak_is_cleared_when_an_environment_resets(make_env):
    env = make_env()
    env.reset()
    term = env.reward_manager.get_term_cfg("foot_swing_height").func
    term.peak_heights[:] = 3.0
    env.reset(env_ids=torch.tensor([2]))
    assert term.peak_heights[:, 0].tolist() == [3.0, 3.0, 0.0, 3.0]


def test_a_landing_of_the_robot_is_counted_once(make_env):
    """A robot falls onto its feet: each foot lands in exactly one step, at any substep."""
    env = make_env(num_envs=2)
    env.reset()
    robot = env.scene["robot"]
    state = robot.data.default_root_state.clone()
    state[:, 2] += torch.tensor([0.05, 0.081])
    robot.write_root_state_to_sim(state)
    landings = torch.zeros(2, 4)
    sensor = env.scene["feet_ground_contact"]
    for _ in range(9):
        env.step(torch.zeros(2, 12))
        landings += sensor.compute_first_contact(dt=env.step_dt)
        assert (env.episode_length_buf > 0).all()
    assert (landings == 1.0).all()
