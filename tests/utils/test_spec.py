"""Functions on specs, and the mocap wrap."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from mjlab.utils.spec import (
    auto_wrap_fixed_base_mocap,
    compile_composed,
    copy_material_data,
    copy_mesh_data,
    copy_texture_data,
    get_free_joint,
    get_non_free_joints,
    is_joint_limited,
    non_default_option_fields,
)

ARM = """
<mujoco model="arm">
  <option timestep="0.01" gravity="0 0 -1"><flag contact="disable"/></option>
  <default><default class="a"><joint damping="1"/></default></default>
  <worldbody>
    <body name="base" pos="0 0 0.5">
      <geom size="0.1"/>
      <body name="link" pos="0 0 0.2">
        <joint name="j1" class="a" range="-90 90"/><geom size="0.1"/>
        <body><joint name="j2" type="slide"/><geom size="0.1"/></body>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="j1"/></actuator>
  <keyframe><key name="home" qpos="0.3 0.1" ctrl="0.2"/></keyframe>
</mujoco>
"""
FLOATING = """
<mujoco><worldbody><body name="base"><freejoint name="root"/><geom size="0.1"/>
  <body><joint name="j" type="ball"/><geom size="0.1"/></body></body></worldbody></mujoco>
"""


def test_free_and_other_joints():
    spec = mujoco.MjSpec.from_string(FLOATING)
    assert get_free_joint(spec).name == "root"
    assert [joint.name for joint in get_non_free_joints(spec)] == ["j"]
    assert get_free_joint(mujoco.MjSpec.from_string(ARM)) is None


@pytest.mark.parametrize(
    ("attributes", "expected"),
    [
        ('range="-1 1"', True),
        ("", False),
        ('range="-1 1" limited="false"', False),
        ('range="-1 1" limited="true"', True),
    ],
)
def test_a_joint_is_limited_as_in_the_compiled_model(attributes, expected):
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><worldbody><body><joint name="j" {attributes}/><geom size="1"/></body>'
        "</worldbody></mujoco>"
    )
    assert is_joint_limited(spec.joint("j")) is expected
    assert bool(spec.compile().jnt_limited[0]) is expected


def test_options_that_differ_from_the_defaults_are_listed():
    assert non_default_option_fields(mujoco.MjSpec().option) == []
    option = mujoco.MjSpec.from_string(ARM).option
    assert non_default_option_fields(option) == ["disableflags", "gravity", "timestep"]


def test_every_option_can_be_noticed():
    names = [name for name in dir(mujoco.MjSpec().option) if not name.startswith("_")]
    for name in names:
        option = mujoco.MjSpec().option
        value = getattr(option, name)
        setattr(option, name, value + 1)
        assert non_default_option_fields(option) == [name]


def test_data_is_copied_and_the_name_is_not():
    spec = mujoco.MjSpec()
    texture = spec.add_texture(name="t1", width=4, height=4, rgb1=[1, 0, 0], nchannel=3)
    texture.builtin = mujoco.mjtBuiltin.mjBUILTIN_CHECKER
    material = spec.add_material(name="m1", rgba=[0, 1, 0, 1], reflectance=0.5)
    material.textures[1] = "t1"
    corners = [0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1]
    mesh = spec.add_mesh(name="me1", uservert=corners, scale=[2, 2, 2], maxhullvert=20)
    new_texture, new_material = spec.add_texture(name="t2"), spec.add_material(name="m2")
    new_mesh = spec.add_mesh(name="me2")
    copy_texture_data(texture, new_texture)
    copy_material_data(material, new_material)
    copy_mesh_data(mesh, new_mesh)
    assert (new_texture.name, new_material.name, new_mesh.name) == ("t2", "m2", "me2")
    assert (new_texture.width, new_texture.builtin) == (4, texture.builtin)
    assert new_texture.rgb1.tolist() == [1, 0, 0]
    assert (new_material.reflectance, new_material.textures[1]) == (0.5, "t1")
    assert list(new_mesh.uservert) == corners
    assert (new_mesh.maxhullvert, new_mesh.scale.tolist()) == (20, [2, 2, 2])


def test_a_copy_needs_a_name_of_its_own():
    spec = mujoco.MjSpec()
    with pytest.raises(ValueError, match=r"'a': expected a named destination"):
        copy_material_data(spec.add_material(name="a"), spec.add_material())


def test_a_fixed_base_is_put_under_a_mocap_body():
    spec = auto_wrap_fixed_base_mocap(lambda: mujoco.MjSpec.from_string(ARM))()
    assert [body.name for body in spec.bodies][:3] == ["world", "mocap_base", "base"]
    model = spec.compile()
    data = mujoco.MjData(model)
    data.mocap_pos[0] = (1, 2, 3)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.body("mocap_base").xpos, (1, 2, 3))
    np.testing.assert_allclose(data.body("base").xpos, (1, 2, 3.5))


def test_the_wrap_keeps_options_keyframes_and_the_rest():
    plain = mujoco.MjSpec.from_string(ARM)
    spec = auto_wrap_fixed_base_mocap(lambda: mujoco.MjSpec.from_string(ARM))()
    assert non_default_option_fields(spec.option) == non_default_option_fields(plain.option)
    assert spec.modelname == "arm"
    wrapped, direct = spec.compile(), plain.compile()
    assert (wrapped.nq, wrapped.nu, wrapped.nkey) == (direct.nq, direct.nu, 1)
    np.testing.assert_array_equal(wrapped.key("home").qpos, [0.3, 0.1])
    np.testing.assert_array_equal(wrapped.key("home").ctrl, [0.2])
    np.testing.assert_array_equal(wrapped.jnt_range, direct.jnt_range)
    np.testing.assert_array_equal(wrapped.dof_damping, direct.dof_damping)
    assert wrapped.opt.timestep == 0.01


ANCHORED = """<mujoco model="anchored"><worldbody>
  <geom name="table" type="box" size=".1 .1 .1"/><site name="hook" pos=".3 0 1"/>
  <camera name="eye" mode="targetbody" target="world" pos="1 0 0"/>
  <body name="a" pos="0 0 1"><joint name="j" axis="0 1 0"/><geom size=".05"/>
    <site name="tip" pos=".3 0 0"/></body></worldbody>
  <equality><connect name="pin" body1="a" anchor=".3 0 0"/><weld name="glue" body1="world" body2="a"/>
    <connect name="sites" site1="tip" site2="hook"/><joint name="lock" joint1="j"/></equality>
  <contact><exclude name="no" body1="world" body2="a"/></contact>
  <sensor><subtreecom name="all" body="world"/><contact name="touch" body1="world" data="found"/>
    <distance name="gap" body1="a" body2="world" cutoff="9"/>
    <framezaxis name="up" objtype="body" objname="world" reftype="site" refname="tip"/>
  </sensor></mujoco>"""


def test_the_mocap_base_takes_the_place_of_the_world():
    alone = mujoco.MjModel.from_xml_string(ANCHORED)
    model = compile_composed(
        auto_wrap_fixed_base_mocap(lambda: mujoco.MjSpec.from_string(ANCHORED))()
    )
    base = model.body("mocap_base").id
    body_equalities = model.eq_objtype == mujoco.mjtObj.mjOBJ_BODY.value
    ends = zip(
        model.eq_obj1id[body_equalities][:2], model.eq_obj2id[body_equalities][:2], strict=True
    )
    assert [tuple(map(int, pair)) for pair in ends] == [(base + 1, base), (base, base + 1)]
    assert model.exclude_signature[0] == (base << 16) + base + 1
    data, data_alone = mujoco.MjData(model), mujoco.MjData(alone)
    data.mocap_pos[0] = (3, -2, 1)
    for m, d in ((model, data), (alone, data_alone)):
        d.qpos[:] = 0.2
        mujoco.mj_forward(m, d)
    np.testing.assert_allclose(data.efc_pos, data_alone.efc_pos, atol=1e-12)
    np.testing.assert_allclose(
        data.sensor("all").data - (3, -2, 1), data_alone.sensor("all").data, atol=1e-12
    )
    for name in ("touch", "gap", "up"):
        np.testing.assert_allclose(data.sensor(name).data, data_alone.sensor(name).data, atol=1e-12)
    data.mocap_quat[0] = (0.8, 0.6, 0, 0)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(
        data.sensor("up").data, data.site("tip").xmat.reshape(3, 3)[2], atol=1e-12
    )


def test_an_empty_spec_becomes_a_lone_mocap_body():
    spec = auto_wrap_fixed_base_mocap(mujoco.MjSpec)()
    assert [body.name for body in spec.bodies] == ["world", "mocap_base"]
    assert spec.compile().nmocap == 1


def test_floating_and_mocap_bases_are_left_alone():
    floating = mujoco.MjSpec.from_string(FLOATING)
    assert auto_wrap_fixed_base_mocap(lambda: floating)() is floating
    once = auto_wrap_fixed_base_mocap(lambda: mujoco.MjSpec.from_string(ARM))
    twice = auto_wrap_fixed_base_mocap(once)()
    assert [body.name for body in twice.bodies].count("mocap_base") == 1


def test_one_spec_can_be_wrapped_again_and_again():
    shared = mujoco.MjSpec.from_string(ARM)
    wrapped = auto_wrap_fixed_base_mocap(lambda: shared)
    assert wrapped().compile().nq == wrapped().compile().nq == 2
    assert shared.compile().nkey == 1


def test_a_mocap_body_that_cannot_stay_one_is_named():
    xml = (
        '<mujoco><worldbody><body name="table"><geom size="1"/></body>'
        '<body name="target" mocap="true"/></worldbody></mujoco>'
    )
    with pytest.raises(ValueError, match=r"mocap bodies \['target'\]"):
        auto_wrap_fixed_base_mocap(lambda: mujoco.MjSpec.from_string(xml))()
