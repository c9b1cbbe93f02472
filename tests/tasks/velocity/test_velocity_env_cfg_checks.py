"""Config mistakes raise a clear error, or warn."""

from __future__ import annotations

import warnings

import pytest
import torch
from velocity_tasks import GO1_ROUGH

from mjlab.tasks.velocity.velocity_env_cfg import get_sensor, remove_sensors


@pytest.mark.parametrize(
    ("term", "param"),
    [
        ("foot_slip", "sensor_name"),
        ("foot_clearance", "height_sensor_name"),
        ("pose", "command_name"),
    ],
)
def test_unknown_names_raise_in_the_first_step(make_env, term, param):
    def edit(cfg):
        cfg.rewards[term].params[param] = "no_such_name"

    env = make_env(edit=edit)
    env.reset()
    with pytest.raises(KeyError, match="Unknown .*'no_such_name'"):
        env.step(torch.zeros(env.num_envs, 12))


def test_unknown_sensors_of_observations_are_named(make_env):
    def edit(cfg):
        terms = cfg.observations["critic"].terms
        terms["foot_air_time"].params["sensor_name"] = "no_such_name"

    with pytest.raises(KeyError, match="'critic/foot_air_time': .*'no_such_name'"):
        make_env(edit=edit)


def test_termination_without_its_sensor(make_env):
    def edit(cfg):
        remove_sensors(cfg, "thigh_ground_touch")

    env = make_env(GO1_ROUGH, edit=edit)
    env.reset()
    with pytest.raises(KeyError, match="Unknown .*'thigh_ground_touch'"):
        env.step(torch.zeros(env.num_envs, 12))


def test_feet_in_another_order_warn_once(make_env):
    def edit(cfg):
        scan = get_sensor(cfg, "foot_height_scan")
        scan.frame = tuple(reversed(scan.frame))

    with pytest.warns(UserWarning, match="the same feet") as caught:
        make_env(edit=edit)
    assert len([one for one in caught if "same feet" in str(one.message)]) == 1


@pytest.mark.parametrize("name", ["foot_clearance", "foot_slip"])
@pytest.mark.parametrize("count", [1, 4])
def test_sites_of_other_feet_warn_in_the_first_step(make_env, name, count):
    def edit(cfg):
        sites = cfg.rewards[name].params["asset_cfg"]
        sites.site_names, sites.preserve_order = sites.site_names[::-1][:count], True

    env = make_env(edit=edit)
    env.reset()
    with pytest.warns(UserWarning, match="the same feet"):
        env.step(torch.zeros(env.num_envs, 12))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.step(torch.zeros(env.num_envs, 12))


def test_an_unknown_sensor_of_a_config_is_named_with_those_that_exist():
    from velocity_tasks import task_cfg

    with pytest.raises(KeyError, match=r"sensor 'scan'.*'foot_height_scan'"):
        get_sensor(task_cfg(), "scan")
