"""The comparison of robots with their tables sees what differs."""

from __future__ import annotations

import copy

import mujoco
import pytest
from robot_drawing import drawing_differences
from robot_figures import compare, differences, figures_of, load_table

from mjlab.asset_zoo.robots.unitree_go1.go1_constants import get_spec

TABLE = load_table("unitree_go1")


def numbers(node, path=()):
    """Yield the path of every number, text and vector of a table."""
    if isinstance(node, dict):
        for key, value in node.items():
            if key != "visual_extent" and key not in ("source_of_figures", "conventions"):
                yield from numbers(value, (*path, key))
    elif isinstance(node, list) and isinstance(node[0], dict):
        for index, value in enumerate(node):
            yield from numbers(value, (*path, index))
    else:
        yield path


def changed(path):
    """Return the table with one entry changed by a ten-thousandth, or another text."""
    table = copy.deepcopy(TABLE)
    node = table
    for key in path[:-1]:
        node = node[key]
    value = node[path[-1]]
    if isinstance(value, str):
        node[path[-1]] = value + "x"
    elif isinstance(value, list):
        node[path[-1]] = [value[0] * 1.0001 + 1e-5, *value[1:]]
    else:
        node[path[-1]] = value * 1.0001 + 1e-5
    return table


def test_a_change_of_any_figure_is_seen():
    figures = figures_of(get_spec().compile())
    paths = list(numbers(TABLE))
    assert len(paths) > 350
    assert [path for path in paths if not compare(figures, changed(path))] == []


@pytest.mark.parametrize(
    ("edit", "problem"),
    [
        (lambda spec: spec.delete(spec.site("imu")), "sites"),
        (lambda spec: spec.delete(spec.geom("FR_foot_collision")), "geoms"),
        (lambda spec: setattr(spec.joint("FR_hip_joint"), "damping", [1.0, 0, 0]), "damping"),
        (lambda spec: setattr(spec.geoms[3], "contype", 1), "drawn only can touch"),
        (lambda spec: setattr(spec.site("FR"), "group", 0), "group 5"),
        (lambda spec: setattr(spec.geom("FR_foot_collision"), "solref", [0.01, 1]), "geom_solref"),
        (lambda spec: spec.worldbody.add_body(name="extra", mass=1), "extra"),
    ],
)
def test_a_model_with_something_else_is_seen(edit, problem):
    spec = get_spec()
    edit(spec)
    if problem == "sites":
        # The sensors of the IMU cannot stay without it.
        for sensor in list(spec.sensors)[:4]:
            spec.delete(sensor)
    assert any(problem in line for line in differences(spec, TABLE))


def test_a_table_with_an_unknown_part_is_not_passed_over():
    assert differences(get_spec(), TABLE | {"tendons": [{"name": "t"}]}) == [
        "tendons: only in the table"
    ]


def test_a_body_drawn_too_large_or_not_at_all_is_seen():
    spec = get_spec()
    spec.body("FR_calf").add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.2, 0.01, 0.01], group=2, mass=0
    )
    for geom in list(spec.body("FL_calf").geoms):
        if geom.group == 2:
            spec.delete(geom)
    assert [line[:7] for line in drawing_differences(spec, TABLE)] == ["FR_calf", "FL_calf"]
