"""Rewards about the body, against values known by hand and references written out."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from stand_ins import StandInEnv, yaw_quat

from mjlab.managers import RewardTermCfg, SceneEntityCfg
from mjlab.tasks.velocity import mdp
from mjlab.utils.lab_api.math import quat_from_euler_xyz

ROOT = SceneEntityCfg("robot")


def term(cls: Any, env: Any, **params: Any) -> Any:
    """Build a class-based term, and return a call of it with its parameters."""
    built = cls(RewardTermCfg(func=cls, weight=1.0, params=params), env)
    return lambda: built(env, **params)


# Tracking.


def test_linear_velocity_is_tracked_in_the_plane_and_kept_zero_upwards():
    env: Any = StandInEnv().command((1.0, 0.5, 9.0), (0.0, 0.0, 0.0))
    env.data.root_link_lin_vel_b[:] = torch.tensor([[0.7, 0.1, 0.2], [0.0, 0.0, 0.0]])
    reward = mdp.track_linear_velocity(env, std=0.5, command_name="twist")
    assert reward.tolist() == pytest.approx([math.exp(-(0.09 + 0.16 + 0.04) / 0.25), 1.0])
    assert env.data.root_link_lin_vel_b[0, 0] == pytest.approx(0.7)


def test_yaw_rate_is_tracked_and_roll_and_pitch_are_kept_zero():
    env: Any = StandInEnv().command((9.0, 9.0, 0.5), (0.0, 0.0, -1.0))
    env.data.root_link_ang_vel_b[:] = torch.tensor([[0.1, 0.2, 0.9], [0.0, 0.0, -1.0]])
    reward = mdp.track_angular_velocity(env, std=2.0, command_name="twist")
    assert reward.tolist() == pytest.approx([math.exp(-(0.16 + 0.01 + 0.04) / 4.0), 1.0])


def test_yaw_rate_alone_is_tracked():
    env: Any = StandInEnv().command((9.0, 9.0, 0.5), (0.0, 0.0, -1.0))
    env.data.root_link_ang_vel_b[:] = torch.tensor([[7.0, 8.0, 0.9], [0.0, 0.0, -1.0]])
    reward = mdp.track_ang_vel_z_exp(env, std=2.0, command_name="twist")
    assert reward.tolist() == pytest.approx([math.exp(-0.16 / 4.0), 1.0])


# Standing upright.


@settings(max_examples=50, deadline=None)
@given(roll=st.floats(-3.1, 3.1), pitch=st.floats(-3.1, 3.1), yaw=st.floats(-3.1, 3.1))
def test_upright_falls_with_the_sine_of_the_tilt(roll, pitch, yaw):
    env: Any = StandInEnv(num_envs=1)
    angles = [torch.tensor([a]) for a in (roll, pitch, yaw)]
    env.data.root_link_quat_w = quat_from_euler_xyz(*angles)
    cos_tilt = math.cos(roll) * math.cos(pitch)
    expected = math.exp(-(1.0 - cos_tilt**2) / 0.2)
    reward = term(mdp.upright, env, std=math.sqrt(0.2), asset_cfg=ROOT)()
    assert reward.item() == pytest.approx(expected, abs=1e-4)


def rays(hits: torch.Tensor) -> Any:
    """Return a ray sensor that hit these points."""
    sensor = mdp.RayCastSensor.__new__(mdp.RayCastSensor)
    sensor._cache_valid = True
    sensor._cached_data = SimpleNamespace(hit_pos_w=hits, distances=torch.ones(hits.shape[:2]))
    return sensor


def test_on_a_slope_upright_is_perpendicular_to_the_ground():
    slope = math.atan(0.5)
    x, y = torch.meshgrid(torch.arange(5.0), torch.arange(4.0), indexing="ij")
    ground = torch.stack((x, y, 0.5 * x), dim=-1).reshape(1, -1, 3)
    env: Any = StandInEnv(num_envs=2, scan=rays(ground.repeat(2, 1, 1)))
    # The first follows the slope: it pitches up. The second stays level.
    pitch = torch.tensor([-slope, 0.0])
    env.data.root_link_quat_w = quat_from_euler_xyz(torch.zeros(2), pitch, torch.zeros(2))
    params = {"std": 0.5, "asset_cfg": ROOT, "terrain_sensor_names": ("scan",)}
    reward = term(mdp.upright, env, **params)()
    assert reward.tolist() == pytest.approx(
        [1.0, math.exp(-(math.sin(slope) ** 2) / 0.25)], abs=1e-5
    )


def test_upright_draws_what_it_compares_and_forgets_it_at_a_reset():
    ground = torch.tensor([[[0.0, 0, 0], [1, 0, 1], [0, 1, 0], [1, 1, 1.0]]]).repeat(2, 1, 1)
    env: Any = StandInEnv(num_envs=2, scan=rays(ground))
    params = {"std": 0.5, "terrain_sensor_names": ("scan",)}
    built = mdp.upright(RewardTermCfg(func=mdp.upright, weight=1.0, params=params), env)
    built(env, **params)
    arrows: list[list[float]] = []
    visualizer: Any = SimpleNamespace(
        get_env_indices=range,
        add_legend=lambda *_: None,
        add_arrow=lambda start, end, color: arrows.append(end.tolist()),
    )
    built.reset(torch.tensor([1]))
    built.debug_vis(visualizer)
    tilted = 0.3 * math.sqrt(0.5)
    up = pytest.approx([0.0, 0.0, 0.3])
    assert arrows == [pytest.approx([-tilted, 0.0, tilted]), up, up, up]


def test_upright_without_a_selection_is_that_of_the_root(go1):
    go1_up = term(mdp.upright, go1, std=0.5)()
    selected = SceneEntityCfg("robot", body_names=("trunk",))
    selected.resolve(go1.scene)
    torch.testing.assert_close(go1_up, term(mdp.upright, go1, std=0.5, asset_cfg=selected)())
    gravity = go1.scene["robot"].data.projected_gravity_b
    expected = torch.exp(-gravity[:, :2].square().sum(dim=1) / 0.25)
    torch.testing.assert_close(go1_up, expected)
    assert (go1_up < 1.0).all()


def test_upright_looks_at_the_selected_body(go1):
    calf = SceneEntityCfg("robot", body_names=("FR_calf",))
    calf.resolve(go1.scene)
    reward = term(mdp.upright, go1, std=0.5, asset_cfg=calf)()
    index = go1.scene["robot"].body_names.index("FR_calf")
    quat = go1.scene["robot"].data.body_link_quat_w[:, index]
    w, x, y, z = quat.unbind(-1)
    tilt = (2 * (x * z - w * y)) ** 2 + (2 * (y * z + w * x)) ** 2
    torch.testing.assert_close(reward, torch.exp(-tilt / 0.25))


# Turning bodies, angular momentum.


def test_roll_and_pitch_rate_of_a_body_cost_and_yaw_rate_does_not(go1):
    calf = SceneEntityCfg("robot", body_names=("FL_calf",))
    calf.resolve(go1.scene)
    data, index = go1.scene["robot"].data, go1.scene["robot"].body_names.index("FL_calf")
    angular = data.body_link_ang_vel_w[:, index]
    cost = mdp.body_angular_velocity_penalty(go1, calf)
    torch.testing.assert_close(cost, angular[:, 0] ** 2 + angular[:, 1] ** 2)
    root = mdp.body_angular_velocity_penalty(go1)
    torch.testing.assert_close(root, data.root_link_ang_vel_w[:, :2].square().sum(dim=1))
    assert (cost != root).all()


@pytest.mark.parametrize("name", ["upright", "body_ang_vel"])
def test_several_bodies_are_an_error(make_env, name):
    def edit(cfg):
        cfg.rewards[name].weight = 1.0
        cfg.rewards[name].params["asset_cfg"].body_names = ("FR_calf", "FL_calf")

    with pytest.raises(ValueError, match=r"exactly one body .*\['FR_calf', 'FL_calf'\]"):
        env = make_env(edit=edit)
        env.reset()
        env.step(torch.zeros(env.num_envs, 12))


@pytest.mark.parametrize("name", ["upright", "body_ang_vel"])
@pytest.mark.parametrize(
    "selected", [{}, {"body_names": ()}, {"body_names": []}, {"body_ids": []}, {"joint_ids": [0]}]
)
def test_root_link_without_selected_bodies(make_env, name, selected):
    def edit(cfg):
        cfg.rewards[name].weight = 1.0
        cfg.rewards[name].params["asset_cfg"] = SceneEntityCfg("robot", **selected)

    env = make_env(edit=edit)
    env.reset()
    for _ in range(3):
        env.step(0.1 * torch.ones(env.num_envs, 12))
    cfg, data = env.reward_manager.get_term_cfg(name), env.scene["robot"].data
    value = cfg.func(env, **cfg.params)
    if name == "upright":
        tilt = data.projected_gravity_b[:, :2].square().sum(dim=1)
        expected = torch.exp(-tilt / cfg.params["std"] ** 2)
    else:
        expected = data.root_link_ang_vel_w[:, :2].square().sum(dim=1)
    torch.testing.assert_close(value, expected)


def test_angular_momentum_costs_its_square_and_is_logged():
    env: Any = StandInEnv(angmom=SimpleNamespace(data=torch.tensor([[3.0, 4.0, 0.0], [0, 0, 1.0]])))
    assert mdp.angular_momentum_penalty(env, "angmom").tolist() == [25.0, 1.0]
    assert env.extras["log"]["Metrics/angular_momentum_mean"] == 3.0


def test_a_diverged_environment_does_not_spoil_what_is_logged():
    momentum = torch.tensor([[3.0, 4.0, 0.0], [math.nan, 0, 0]])
    env: Any = StandInEnv(angmom=SimpleNamespace(data=momentum))
    mdp.angular_momentum_penalty(env, "angmom")
    assert env.extras["log"]["Metrics/angular_momentum_mean"] == 5.0


# Posture.

JOINTS = ("hip", "thigh", "calf")
STANDING = {".*": 0.1}
WALKING = {"hip": 0.2, "thigh|calf": 0.4}
RUNNING = {"hip|thigh": 0.5, "calf": 1.0}


def posture_env() -> Any:
    env: Any = StandInEnv(num_envs=4)
    env.data.joint_pos = torch.tensor([[0.1, -0.2, 0.3]]).repeat(4, 1)
    env.data.default_joint_pos = torch.tensor([[0.0, 0.1, 0.1]]).repeat(4, 1)
    # By the sum of linear and angular speed: 0.49 stands, 0.5 walks, 1.4 walks, 1.5 runs.
    return env.command((0.3, 0.0, 0.19), (0.0, 0.3, -0.2), (0.6, 0.8, -0.4), (0.6, 0.8, 0.5))


def posture_params(**changes: Any) -> dict[str, Any]:
    params = {
        "std_standing": STANDING,
        "std_walking": WALKING,
        "std_running": RUNNING,
        "asset_cfg": SceneEntityCfg("robot", joint_names=JOINTS),
        "command_name": "twist",
    }
    return {**params, **changes}


def test_posture_is_kept_as_loosely_as_the_command_is_fast():
    env = posture_env()
    reward = term(mdp.variable_posture, env, **posture_params())()
    error = (0.1, -0.3, 0.2)
    stds = [(0.1, 0.1, 0.1), (0.2, 0.4, 0.4), (0.2, 0.4, 0.4), (0.5, 0.5, 1.0)]
    expected = [
        math.exp(-sum((e / s) ** 2 for e, s in zip(error, std, strict=True)) / 3) for std in stds
    ]
    assert reward.tolist() == pytest.approx(expected, rel=1e-5)
    assert env.data.joint_pos[0].tolist() == pytest.approx([0.1, -0.2, 0.3])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"std_walking": {"hip": 0.1, "thig": 0.2}}, "std_walking: These patterns match no name"),
        ({"std_running": {".*": 0.1, "hip": 0.2}}, "std_running: The name 'hip' is matched by sev"),
        ({"std_running": {"hip": 0.1}}, r"std_running: .*missing: \['thigh', 'c"),
    ],
)
def test_tables_that_do_not_fit_are_refused_when_the_term_is_built(changes, message):
    with pytest.raises(ValueError, match=message):
        term(mdp.variable_posture, posture_env(), **posture_params(**changes))


# Older names.


def test_flat_orientation_is_upright_without_terrain():
    from mjlab.tasks.velocity.mdp import rewards

    env: Any = StandInEnv(num_envs=2)
    env.data.root_link_quat_w = quat_from_euler_xyz(*torch.tensor([[0.3, -0.2]] * 3))
    with pytest.warns(FutureWarning, match="flat_orientation is deprecated"):
        older = rewards.flat_orientation(env, std=0.5)
    assert torch.equal(older, term(mdp.upright, env, std=0.5)())
    env.data.root_link_quat_w = yaw_quat(torch.tensor([0.4, 1.0]))
    assert mdp.flat_orientation(env, std=0.5).tolist() == [1.0, 1.0]
