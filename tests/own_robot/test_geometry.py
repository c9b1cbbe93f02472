"""Lowest points, chains and colliding geoms."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from mjlab.own_robot import geometry as geo

_GEOM = mujoco.mjtGeom
SHAPES = [
    (_GEOM.mjGEOM_SPHERE, (0.1, 0, 0)),
    (_GEOM.mjGEOM_CAPSULE, (0.05, 0.2, 0)),
    (_GEOM.mjGEOM_CYLINDER, (0.1, 0.05, 0)),
    (_GEOM.mjGEOM_BOX, (0.1, 0.2, 0.05)),
    (_GEOM.mjGEOM_ELLIPSOID, (0.1, 0.2, 0.05)),
    (_GEOM.mjGEOM_MESH, (0, 0, 0)),
]


@pytest.mark.parametrize(("shape", "size"), SHAPES)
def test_lowest_point_is_mujocos(shape, size):
    rng = np.random.default_rng(int(shape))
    spec = mujoco.MjSpec()
    spec.add_mesh(name="mesh", uservert=rng.normal(scale=0.1, size=60))
    spec.worldbody.add_geom(name="ground", type=_GEOM.mjGEOM_PLANE, size=(5, 5, 0.1))
    body = spec.worldbody.add_body()
    body.add_freejoint()
    body.add_geom(name="shape", type=shape, size=size)
    if shape == _GEOM.mjGEOM_MESH:
        spec.geom("shape").meshname = "mesh"
    model = spec.compile()
    data = mujoco.MjData(model)
    for _ in range(10):
        quat = rng.normal(size=4)
        data.qpos[:] = (*rng.uniform(-1, 1, 2), 1.0, *(quat / np.linalg.norm(quat)))
        mujoco.mj_kinematics(model, data)
        expected = mujoco.mj_geomDistance(model, data, 0, model.geom("shape").id, 5.0, None)
        lowest = geo.lowest_point(model, data, model.geom("shape").id)
        assert lowest[2] == pytest.approx(expected, abs=2e-3)


def test_welded_bodies_are_one_link():
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body name="a"><freejoint/>
      <geom size=".1"/><body name="b"><joint name="j"/><geom size=".1"/>
      <body name="c"><geom size=".1"/></body></body></body></worldbody></mujoco>""")
    ids = {name: model.body(name).id for name in "abc"}
    assert geo.links(model) == [ids["a"], ids["b"]]
    assert geo.leaf_links(model) == [ids["b"]]
    assert geo.chain_joints(model, ids["b"], ids["a"]) == [model.joint("j").id]


@pytest.mark.parametrize(
    ("attributes", "pair", "expected"),
    [
        (("contype='0'", "contype='0' conaffinity='0'", "contype='0' conaffinity='0'"), "", {"a"}),
        (("", "contype='0' conaffinity='0'", "contype='0' conaffinity='0'"), "", {"a"}),
        (("contype='0' conaffinity='0'",) * 3, "<pair geom1='b' geom2='floor'/>", {"b"}),
        (("contype='0' conaffinity='0'",) * 3, "", {"c"}),
    ],
    ids=["conaffinity", "contype", "pair", "highest group"],
)
def test_colliding_geoms(attributes, pair, expected):
    geoms = "".join(
        f"<geom name='{name}' size='.1' group='{group}' {more}/>"
        for group, (name, more) in enumerate(zip("abc", attributes, strict=True))
    )
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody>
      <geom name="floor" type="plane" size="1 1 1" contype="1"/>
      <body><freejoint/>{geoms}</body></worldbody><contact>{pair}</contact></mujoco>""")
    assert {model.geom(g).name for g in geo.colliding_geoms(model)} == expected
