"""Laws of every robot: parameters of its table, configs that share nothing, files of the package."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import pytest
from robot_drawing import drawing_differences
from robot_figures import differences, load_table

import mjlab
from mjlab import compat
from mjlab.asset_zoo.robots import get_g1_robot_cfg, get_go1_robot_cfg, get_yam_robot_cfg
from mjlab.asset_zoo.robots.i2rt_yam import yam_constants
from mjlab.asset_zoo.robots.unitree_g1 import g1_constants
from mjlab.asset_zoo.robots.unitree_go1 import go1_constants

MODULES = {"unitree_g1": g1_constants, "unitree_go1": go1_constants, "i2rt_yam": yam_constants}
MAKERS = {"unitree_g1": get_g1_robot_cfg, "unitree_go1": get_go1_robot_cfg}
MAKERS["i2rt_yam"] = get_yam_robot_cfg

robots = pytest.mark.parametrize("robot", MODULES)


@robots
def test_parameters_are_those_of_the_table(robot):
    assert differences(MODULES[robot].get_spec(), load_table(robot)) == []


@robots
def test_bodies_are_drawn_as_large_as_in_the_table(robot):
    assert drawing_differences(MODULES[robot].get_spec(), load_table(robot)) == []


@robots
def test_a_changed_config_leaves_the_next_one_alone(robot):
    make = MAKERS[robot]
    changed, before = make(), make()
    changed.init_state.joint_pos.clear()
    changed.articulation.actuators[0].stiffness = 1.0
    for field in dataclasses.fields(changed.collisions[0]):
        value = getattr(changed.collisions[0], field.name)
        if isinstance(value, dict):
            value.clear()
    assert changed != before
    assert make() == before
    assert before.init_state.joint_pos


@pytest.mark.parametrize(
    ("robot", "file", "license_name"),
    [
        ("unitree_g1", "G1_XML", "BSD 3-Clause"),
        ("unitree_go1", "GO1_XML", "BSD 3-Clause"),
        ("i2rt_yam", "YAM_XML", "MIT License"),
    ],
)
def test_models_ship_with_their_license(robot, file, license_name):
    path = getattr(MODULES[robot], file)
    assert path.is_file()
    assert path.is_relative_to(Path(mjlab.__file__).parent)
    assert (path.parents[1] / "README.md").read_text().count(license_name) == 1


@robots
def test_older_loaders_of_meshes_find_none(robot):
    compat._warn_once.cache_clear()
    with pytest.warns(FutureWarning, match="get_assets"):
        assert MODULES[robot].get_assets("assets") == {}


def test_naming_a_robot_loads_nothing():
    code = (
        "import sys, mjlab.asset_zoo.robots as robots\n"
        "assert 'get_go1_robot_cfg' in robots.__all__\n"
        "heavy = {'torch', 'mujoco'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
