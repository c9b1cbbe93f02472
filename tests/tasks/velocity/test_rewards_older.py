"""Foot terms of releases 1.1 and 1.2: sites in `asset_cfg` instead of a height sensor."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from stand_ins import StandInEnv, contacts

from mjlab import compat
from mjlab.managers import ObservationTermCfg, RewardTermCfg, SceneEntityCfg
from mjlab.tasks.velocity import mdp
from mjlab.tasks.velocity.velocity_env_cfg import make_velocity_env_cfg

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning")


@pytest.fixture(autouse=True)
def _forget_warnings():
    compat._warn_once.cache_clear()


@pytest.fixture
def env() -> Any:
    env: Any = StandInEnv()
    env.command((0.5, 0.0, 0.0), (0.0, 0.0, 0.02))
    env.data.site_pos_w = torch.tensor(
        [[[1.0, 2, 0.10], [1, 2, 0.2], [0, 0, 0.3]], [[0, 0, 0.05], [0, 0, 0.15], [0, 0, 0.25]]]
    )
    env.data.site_lin_vel_w = torch.tensor(
        [[[3.0, 4, 9], [1, 0, 9], [0, 2, 9]], [[0, 0, 5.0], [6, 8, 1], [0.5, 0, 0]]]
    )
    return env


FEET = SceneEntityCfg("robot", site_names=("left", "right"), site_ids=[0, 2])


def test_heights_of_feet_are_those_of_their_sites(env):
    expected = pytest.approx([0.1, 0.3, 0.05, 0.25])
    assert mdp.foot_height(env, asset_cfg=FEET).flatten().tolist() == expected
    assert mdp.foot_height(env, FEET).flatten().tolist() == expected  # ty: ignore


def test_clearance_has_the_values_of_release_1_1(env):
    # By hand, and as release 1.1.1 returns them.
    params = {"target_height": 0.12, "asset_cfg": FEET}
    assert mdp.feet_clearance(env, **params).tolist() == pytest.approx([0.46, 0.065])
    params |= {"command_name": "twist", "command_threshold": 0.05}
    assert mdp.feet_clearance(env, **params).tolist() == pytest.approx([0.46, 0.0])


def test_a_sensor_that_is_named_wins_over_sites(env):
    env.scene["scan"] = SimpleNamespace(data=SimpleNamespace(heights=torch.full((2, 2), 0.12)))
    cost = mdp.feet_clearance(env, 0.12, height_sensor_name="scan", asset_cfg=FEET)
    assert cost.tolist() == [0.0, 0.0]


def test_neither_sensor_nor_sites_is_an_error(env):
    with pytest.raises(TypeError, match="sensor_name"):
        mdp.foot_height(env)


def test_swing_height_has_the_values_of_release_1_1(env, monkeypatch):
    from mjlab.compat import older_terms

    found = torch.tensor([[0, 1.0, 0], [0, 0, 1.0]])
    sensor = contacts(found=found, landed=torch.zeros(2, 3).bool())
    env.scene["feet"] = sensor
    monkeypatch.setattr(older_terms, "check_same_feet", lambda *args: None)
    params = {
        "sensor_name": "feet",
        "target_height": 0.1,
        "command_name": "twist",
        "command_threshold": 0.05,
        "asset_cfg": SceneEntityCfg("robot", site_ids=[0, 1, 2]),
    }
    cfg = RewardTermCfg(func=mdp.feet_swing_height, weight=1.0, params=params)
    term: Any = older_terms.feet_swing_height(cfg, env)
    assert isinstance(term, mdp.feet_swing_height)
    assert term(env, **params).tolist() == [0.0, 0.0]
    assert term.peak_heights.flatten().tolist() == pytest.approx([0.1, 0.0, 0.3, 0.05, 0.15, 0.0])
    env.data.site_pos_w[..., 2] *= 0.5
    landed = torch.tensor([[True, True, False], [True, False, True]])
    sensor.compute_first_contact = lambda dt: landed
    assert term(env, **params).tolist() == pytest.approx([1.0, 0.0])
    assert env.extras["log"]["Metrics/peak_height_mean"].item() == pytest.approx(0.0375)
    assert term.peak_heights.flatten().tolist() == pytest.approx([0.0, 0.0, 0.3, 0.0, 0.15, 0.0])


def to_sites(cfg: Any) -> None:
    """Spell the foot terms of a velocity task as the templates of 1.1 and 1.2 did."""
    feet = dict(cfg.rewards["foot_clearance"].params)["asset_cfg"]
    sites = {"asset_cfg": SceneEntityCfg(feet.name, site_names=feet.site_names)}
    cfg.observations["critic"].terms["foot_height"] = ObservationTermCfg(
        func=mdp.foot_height, params=sites
    )
    for name in ("foot_clearance", "foot_swing_height"):
        reward = cfg.rewards[name]
        reward.weight = -1.0
        reward.params.pop("height_sensor_name")
        reward.params |= sites


def test_the_template_of_1_1_builds_steps_and_warns_once_a_term(make_env):
    with pytest.warns(FutureWarning, match="site heights above z = 0") as seen:
        env = make_env(edit=to_sites)
        env.reset()
        observations, *_ = env.step(torch.zeros(env.num_envs, 12))
    assert len([w for w in seen if "site heights" in str(w.message)]) == 3
    sites, _ = env.scene["robot"].find_sites(("FR", "FL", "RR", "RL"))
    heights = env.scene["robot"].data.site_pos_w[:, sites, 2]
    windows = observations["critic"].unfold(1, 4, 1)
    assert (windows == heights[:, None]).all(dim=2).all(dim=0).any()


def _feet_terms(cfg) -> list[Any]:
    critic = cfg.observations["critic"].terms
    return [critic["foot_height"], cfg.rewards["foot_clearance"], cfg.rewards["foot_swing_height"]]


def test_sites_filled_in_the_template_replace_its_height_sensor():
    cfg = make_velocity_env_cfg()
    for term in _feet_terms(cfg):
        term.params["asset_cfg"].site_names = ("left", "right")
    compat.translate_older(cfg)
    for term in _feet_terms(cfg):
        assert "foot_height_scan" not in term.params.values()
        assert term.params["asset_cfg"].site_names == ("left", "right")
        assert term.func.__module__ == "mjlab.compat.older_terms"
    assert [sensor.name for sensor in cfg.scene.sensors] == ["terrain_scan"]


def test_sites_left_empty_in_the_template_are_dropped():
    cfg = make_velocity_env_cfg()
    height, clearance, swing = _feet_terms(cfg)
    clearance.params["asset_cfg"].site_names = ("left", "right")
    compat.translate_older(cfg)
    assert height.params == {"sensor_name": "foot_height_scan"}
    assert clearance.func is mdp.feet_clearance
    assert clearance.params["asset_cfg"].site_names == ("left", "right")
    assert swing.func is mdp.feet_swing_height
    assert "asset_cfg" not in swing.params
    assert [sensor.name for sensor in cfg.scene.sensors] == ["terrain_scan", "foot_height_scan"]


@pytest.mark.parametrize("takes_sites", [False, True])
def test_empty_sites_stay_if_a_custom_term_takes_them(takes_sites):
    def without(env, sensor_name, height_sensor_name, target_height):
        pass

    def with_sites(env, asset_cfg, **params):
        pass

    cfg = make_velocity_env_cfg()
    swing = _feet_terms(cfg)[2]
    swing.func = with_sites if takes_sites else without
    swing.params["height_sensor_name"] = "own_scan"
    compat.translate_older(cfg)
    assert ("asset_cfg" in swing.params) == takes_sites


def test_sites_in_another_order_warn(make_env):
    def edit(cfg):
        to_sites(cfg)
        names = cfg.rewards["foot_clearance"].params["asset_cfg"].site_names
        cfg.rewards["foot_swing_height"].params["asset_cfg"] = SceneEntityCfg(
            "robot", site_names=tuple(reversed(names)), preserve_order=True
        )

    with pytest.warns(UserWarning, match="the same feet in the same order"):
        env = make_env(edit=edit)
    env.reset()
    _, reward, *_ = env.step(torch.zeros(env.num_envs, 12))
    assert reward.isfinite().all()
