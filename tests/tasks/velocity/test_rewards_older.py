"""Foot terms of releases 1.1 and 1.2: sites in `asset_cfg` instead of a height sensor."""

from __future__ import annotations

import copy
import pickle
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
    from mjlab.tasks.velocity.mdp import rewards as feet_rewards
    from mjlab.tasks.velocity.mdp.observations import Source

    found = torch.tensor([[0, 1.0, 0], [0, 0, 1.0]])
    sensor = contacts(found=found, landed=torch.zeros(2, 3).bool())
    env.scene["feet"] = sensor
    feet = Source("feet", [("a", 1), ("b", 2), ("c", 3)])
    monkeypatch.setattr(feet_rewards, "check_air_time_sensor", lambda *args: None)
    monkeypatch.setattr(feet_rewards, "contact_columns", lambda *args: feet)
    monkeypatch.setattr(older_terms, "check_same_feet", lambda *args: None)
    monkeypatch.setattr(older_terms, "site_columns", lambda *args: feet)
    params = {
        "sensor_name": "feet",
        "target_height": 0.1,
        "command_name": "twist",
        "command_threshold": 0.05,
        "asset_cfg": SceneEntityCfg("robot", site_ids=[0, 1, 2]),
    }
    cfg = RewardTermCfg(func=mdp.feet_swing_height, weight=1.0, params=params)
    term: Any = mdp.feet_swing_height(cfg, env)
    assert isinstance(term, mdp.feet_swing_height)
    assert term(env, **params).tolist() == [0.0, 0.0]
    assert term.peak_heights.flatten().tolist() == pytest.approx([0.1, 0.0, 0.3, 0.05, 0.15, 0.0])
    env.data.site_pos_w[..., 2] *= 0.5
    landed = torch.tensor([[True, True, False], [True, False, True]])
    sensor.compute_first_contact = lambda dt: landed
    assert term(env, **params).tolist() == pytest.approx([1.0, 0.0])
    assert env.extras["log"]["Metrics/peak_height_mean"].item() == pytest.approx(0.0375)
    assert term.peak_heights.flatten().tolist() == pytest.approx([0.0, 0.0, 0.3, 0.0, 0.15, 0.0])


def test_older_swing_height_can_be_copied():
    from mjlab.compat import older_terms

    for cls in (mdp.feet_swing_height, older_terms.feet_swing_height):
        term: Any = object.__new__(cls)
        term.peak_heights = torch.ones(2, 2)
        for copied in (copy.copy(term), copy.deepcopy(term), pickle.loads(pickle.dumps(term))):
            assert type(copied) is cls
            assert torch.equal(copied.peak_heights, term.peak_heights)


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


def test_sites_of_other_feet_than_the_contacts_are_refused(make_env):
    def edit(cfg):
        to_sites(cfg)
        names = cfg.rewards["foot_clearance"].params["asset_cfg"].site_names
        cfg.rewards["foot_swing_height"].params["asset_cfg"] = SceneEntityCfg(
            "robot", site_names=tuple(names)[:2]
        )

    with pytest.raises(ValueError, match="same feet"):
        make_env(edit=edit)


def _feet_terms(cfg) -> list[Any]:
    critic = cfg.observations["critic"].terms
    return [critic["foot_height"], cfg.rewards["foot_clearance"], cfg.rewards["foot_swing_height"]]


@pytest.mark.parametrize("prepare", [lambda cfg: cfg, copy.deepcopy], ids=["new", "copied"])
def test_setting_sites_in_the_template_removes_its_height_sensor(prepare):
    cfg = prepare(make_velocity_env_cfg())
    sensors = [sensor.name for sensor in cfg.scene.sensors]
    assert "foot_height_scan" in sensors
    for term in _feet_terms(cfg):
        term.params["asset_cfg"].site_names = ("left", "right")
    for term in _feet_terms(cfg):
        assert "foot_height_scan" not in term.params.values()
        assert term.params["asset_cfg"].site_names == ("left", "right")
    assert _feet_terms(cfg)[2].params["sensor_name"] == "feet_ground_contact"
    left = [sensor.name for sensor in cfg.scene.sensors]
    assert left == [name for name in sensors if name != "foot_height_scan"]


def test_a_template_whose_sites_are_not_asked_for_keeps_its_sensor():
    cfg = make_velocity_env_cfg()
    cfg.rewards["foot_clearance"].params["asset_cfg"].site_names = ("left", "right")
    alone = copy.deepcopy(cfg.observations["critic"].terms["foot_height"])
    for params in (cfg.observations["critic"].terms["foot_height"].params, alone.params):
        assert params == {"sensor_name": "foot_height_scan"}
        assert "asset_cfg" not in params
        with pytest.raises(KeyError, match="no_such_parameter"):
            params["no_such_parameter"]
    with pytest.raises(KeyError, match="asset_cfg"):
        alone.params["asset_cfg"]
    assert "foot_height_scan" in [sensor.name for sensor in cfg.scene.sensors]


def test_sites_in_another_order_than_the_contacts_are_accepted_with_a_warning(make_env):
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
