"""Config mistakes raise a clear error when the environment is built."""

from __future__ import annotations

import dataclasses
import warnings

import pytest
import torch
from velocity_tasks import GO1_ROUGH

from mjlab.managers import RewardTermCfg, SceneEntityCfg
from mjlab.sensor import BuiltinSensorCfg, ObjRef
from mjlab.tasks.velocity import mdp
from mjlab.tasks.velocity.velocity_env_cfg import get_sensor, remove_sensors


def params_of(cfg, term):
    """The parameters of a reward, which gets a weight: without one it is not checked."""
    cfg.rewards[term].weight = cfg.rewards[term].weight or -1.0
    return cfg.rewards[term].params


@pytest.mark.parametrize(
    ("term", "param", "message"),
    [
        ("foot_slip", "sensor_name", "'feet_ground_contct'.*did you mean 'feet_ground_contact'"),
        ("foot_swing_height", "sensor_name", "sensor 'feet_ground_contct'"),
        ("soft_landing", "sensor_name", "sensor 'feet_ground_contct'"),
        ("air_time", "sensor_name", "sensor 'feet_ground_contct'"),
        ("angular_momentum", "sensor_name", "sensor 'feet_ground_contct'"),
        ("foot_clearance", "height_sensor_name", "sensor 'feet_ground_contct'"),
        ("track_linear_velocity", "command_name", "command 'feet_ground_contct'"),
        ("track_angular_velocity", "command_name", "command"),
        ("pose", "command_name", "command"),
        ("foot_slip", "command_name", "command"),
        ("foot_swing_height", "command_name", "command"),
        ("soft_landing", "command_name", "command"),
    ],
)
def test_a_sensor_or_command_that_does_not_exist_is_named_with_near_ones(
    make_env, term, param, message
):
    def edit(cfg):
        params_of(cfg, term)[param] = "feet_ground_contct"

    with pytest.raises(ValueError, match=f"RewardManager term '{term}': .*{message}"):
        make_env(edit=edit)


@pytest.mark.parametrize(
    ("group", "term"),
    [("critic", "foot_height"), ("critic", "foot_air_time"), ("critic", "foot_contact")],
)
def test_a_sensor_that_observations_need_is_named_too(make_env, group, term):
    def edit(cfg):
        cfg.observations[group].terms[term].params["sensor_name"] = "foot_height_scn"

    with pytest.raises(ValueError, match=f"'critic/{term}': .*sensor 'foot_height_scn'.*did you"):
        make_env(edit=edit)


def test_clearance_without_heights_or_sites_asks_for_its_height_sensor(make_env):
    def edit(cfg):
        params = params_of(cfg, "foot_clearance")
        del params["height_sensor_name"], params["asset_cfg"]

    with pytest.raises(TypeError, match="'foot_clearance': .*missing .*'height_sensor_name'"):
        make_env(edit=edit)


def test_a_sensor_of_another_kind_is_refused_with_those_of_the_right_one(make_env):
    def edit(cfg):
        params_of(cfg, "foot_slip")["sensor_name"] = "foot_height_scan"

    message = "ContactSensor.*TerrainHeightSensor.*feet_ground_contact"
    with pytest.raises(TypeError, match=message):
        make_env(edit=edit)


def test_a_termination_without_its_sensor_is_refused(make_env):
    def edit(cfg):
        remove_sensors(cfg, "thigh_ground_touch")

    with pytest.raises(ValueError, match="'illegal_contact': .*sensor 'thigh_ground_touch'"):
        make_env(GO1_ROUGH, edit=edit)


@pytest.mark.parametrize(
    ("term", "other"),
    [
        ("foot_clearance", "asset_cfg.site_names"),
        ("foot_swing_height", "height sensor 'foot_height_scan'"),
    ],
)
def test_feet_in_another_order_warn(make_env, term, other):
    def edit(cfg):
        scan = get_sensor(cfg, "foot_height_scan")
        scan.frame = tuple(reversed(scan.frame))
        cfg.rewards = {term: cfg.rewards[term]}

    with pytest.warns(UserWarning, match=f"'{term}': .*{other}.*same feet in the same order") as w:
        make_env(edit=edit)
    assert len([one for one in w if "same feet" in str(one.message)]) == 1


def test_sites_that_are_not_the_feet_in_contact_warn(make_env):
    def edit(cfg):
        asset_cfg = params_of(cfg, "foot_slip")["asset_cfg"]
        asset_cfg.site_names, asset_cfg.preserve_order = ("FL", "FR", "RR", "RL"), True

    with pytest.warns(UserWarning, match=r"'foot_slip': .*same order.*\['FL', 'FR', 'RR', 'RL'\]"):
        make_env(edit=edit)


def test_one_foot_counts_for_all_contacts(make_env):
    def edit(cfg):
        params_of(cfg, "foot_slip")["asset_cfg"].site_names = ("FR",)

    with pytest.warns(UserWarning, match="'foot_slip': .*same feet"):
        env = make_env(edit=edit)
    env.reset()
    env.step(torch.zeros(env.num_envs, 12))


def test_one_foot_counts_for_all_slots(make_env):
    def edit(cfg):
        params_of(cfg, "foot_slip")["asset_cfg"].site_names = ("FR",)
        cfg.scene.sensors = tuple(
            dataclasses.replace(s, num_slots=2, reduce="maxforce")
            if s.name == "feet_ground_contact"
            else s
            for s in cfg.scene.sensors
        )
        cfg.rewards = {"foot_slip": cfg.rewards["foot_slip"]}
        del cfg.observations["critic"]

    with pytest.warns(UserWarning, match="'foot_slip': .*num_slots.*got 2"):
        env = make_env(edit=edit)
    env.reset()
    env.scene["robot"].data.joint_vel[:] = 1.0
    params = env.cfg.rewards["foot_slip"].params | {"command_threshold": -1.0}
    foot = env.scene["robot"].site_names.index("FR")
    env.sim.forward()
    speed = env.scene["robot"].data.site_lin_vel_w[:, foot, :2].square().sum(dim=1)
    found = env.scene["feet_ground_contact"].data.found
    assert found.shape[1] == 8
    slip = env.reward_manager.get_term_cfg("foot_slip")
    cost = slip.func(env, **(params | {"asset_cfg": slip.params["asset_cfg"]}))
    torch.testing.assert_close(cost, (found > 0).sum(dim=1) * speed)


def test_a_foot_less_is_refused(make_env):
    def edit(cfg):
        params_of(cfg, "foot_slip")["asset_cfg"].site_names = ("FR", "FL", "RR")

    with pytest.raises(ValueError, match="same feet"):
        make_env(edit=edit)


@pytest.mark.parametrize(
    ("term", "changes", "message"),
    [
        ("foot_swing_height", {"track_air_time": False}, "track_air_time: expected True"),
        ("foot_slip", {"num_slots": 2, "reduce": "maxforce"}, "num_slots: expected 1 .*got 2"),
        ("soft_landing", {"fields": ("found",)}, r"\['force'\]"),
        ("foot_slip", {"fields": ("force",), "track_air_time": False}, r"\['found'\]"),
    ],
)
def test_a_contact_sensor_that_does_not_measure_what_is_needed_is_refused(
    make_env, term, changes, message
):
    def edit(cfg):
        cfg.scene.sensors = tuple(
            dataclasses.replace(s, **changes) if s.name == "feet_ground_contact" else s
            for s in cfg.scene.sensors
        )
        cfg.rewards = {term: cfg.rewards[term]}
        del cfg.observations["critic"]

    with pytest.raises(ValueError, match=f"'{term}': .*{message}"):
        make_env(edit=edit)


@pytest.mark.parametrize(
    ("term", "changes", "message"),
    [
        ("foot_air_time", {"track_air_time": False}, "track_air_time: expected True"),
        ("foot_contact", {"fields": ("force",), "track_air_time": False}, r"\['found'\]"),
        ("foot_contact_forces", {"fields": ("found",)}, r"\['force'\]"),
        ("foot_height", {"reduction": "none"}, "reduction='none'"),
    ],
)
def test_a_sensor_that_does_not_measure_what_is_observed_is_refused(
    make_env, term, changes, message
):
    def edit(cfg):
        terms = cfg.observations["critic"].terms
        name = terms[term].params["sensor_name"]
        cfg.observations["critic"].terms = {term: terms[term]}
        cfg.scene.sensors = tuple(
            dataclasses.replace(s, **changes) if s.name == name else s for s in cfg.scene.sensors
        )

    with pytest.raises(ValueError, match=f"'critic/{term}': .*{message}"):
        make_env(edit=edit)


def test_heights_of_rays_are_no_heights_of_feet(make_env):
    def edit(cfg):
        get_sensor(cfg, "foot_height_scan").reduction = "none"
        del cfg.observations["critic"]

    with pytest.raises(ValueError, match="'foot_clearance': .*reduction='none'"):
        make_env(edit=edit)


@pytest.mark.parametrize(
    ("term", "param", "value", "message"),
    [
        ("track_linear_velocity", "std", -0.5, "std.*-0.5"),
        ("track_angular_velocity", "std", 0.0, "std.*0.0"),
        ("foot_swing_height", "target_height", 0.0, "target_height.*0.0"),
        ("air_time", "threshold_min", 0.5, "threshold_min: .*threshold_max 0.5, got 0.5"),
    ],
)
def test_numbers_that_make_no_sense_warn(make_env, term, param, value, message):
    def edit(cfg):
        params_of(cfg, term)[param] = value

    with pytest.warns(UserWarning, match=f"'{term}': .*{message}") as caught:
        make_env(edit=edit)
    assert len([one for one in caught if param in str(one.message)]) == 1


def test_angular_momentum_has_three_components(make_env):
    def edit(cfg):
        trunk = ObjRef(type="body", name="trunk", entity="robot")
        turned = BuiltinSensorCfg(name="turned", sensor_type="framequat", obj=trunk)
        cfg.scene.sensors += (turned,)
        params_of(cfg, "angular_momentum")["sensor_name"] = "robot/turned"

    with pytest.raises(ValueError, match="'robot/turned': expected 3 values, got 4"):
        make_env(edit=edit)


def test_upright_needs_rays_of_a_sensor_that_exists(make_env):
    def edit(cfg):
        params_of(cfg, "upright")["terrain_sensor_names"] = ("terrain_scn",)

    with pytest.raises(ValueError, match="'upright': .*'terrain_scn'.*did you mean 'terrain_scan'"):
        make_env(GO1_ROUGH, edit=edit)


def test_an_unknown_sensor_of_a_config_is_named_with_those_that_exist():
    from velocity_tasks import task_cfg

    with pytest.raises(KeyError, match=r"sensor 'scan'.*'foot_height_scan'"):
        get_sensor(task_cfg(), "scan")


def test_a_selection_made_in_every_step_warns_once(make_env):
    def own(env):
        return mdp.joint_vel_l2(env, SceneEntityCfg("robot", joint_names="FL_hip_joint"))

    def edit(cfg):
        cfg.rewards["own"] = RewardTermCfg(func=own, weight=1.0)

    env = make_env(edit=edit)
    env.reset()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for _ in range(4):
            env.step(torch.zeros(env.num_envs, 12))
    assert len([one for one in caught if "never resolved" in str(one.message)]) == 1
