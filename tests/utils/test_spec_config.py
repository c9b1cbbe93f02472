"""Spec editors, checked on the compiled model if possible."""

from __future__ import annotations

import warnings

import mujoco
import numpy as np
import pytest

from mjlab.utils.spec_config import (
    CameraCfg,
    CollisionCfg,
    GeomCfg,
    LightCfg,
    MaterialCfg,
    MeshCfg,
    TextureCfg,
    warn_overlapping_geom_edits,
)

XML = """
<mujoco><worldbody>
  <body name="base">
    <geom name="foot_left" size="0.1"/><geom name="foot_right" size="0.1"/>
    <geom name="torso" size="0.1"/><geom size="0.1"/>
  </body>
</worldbody></mujoco>
"""
REQUIRED = {"contype": 1, "conaffinity": 1, "condim": 3, "priority": 0}


@pytest.fixture
def spec():
    return mujoco.MjSpec.from_string(XML)


def test_a_geom_patch_changes_only_what_it_names(spec):
    GeomCfg(
        geom_names_expr=("foot", "torso"),
        group={"torso": 3},
        condim={"foot_left": 6, "foot": 4},
        friction=(0.7,),
        solimp={"torso": (0.8, 0.9)},
        margin=0.02,
    ).edit_spec(spec)
    model = spec.compile()
    assert model.geom_group.tolist() == [0, 0, 3, 0]
    assert model.geom_condim.tolist() == [6, 4, 3, 3]
    np.testing.assert_allclose(model.geom_friction[:3, 0], 0.7)
    np.testing.assert_allclose(model.geom_friction[0, 1:], [0.005, 0.0001])
    np.testing.assert_allclose(model.geom_solimp[2], [0.8, 0.9, 0.001, 0.5, 2.0])
    np.testing.assert_allclose(model.geom_solimp[0], [0.9, 0.95, 0.001, 0.5, 2.0])
    np.testing.assert_allclose(model.geom_margin, [0.02, 0.02, 0.02, 0.0])


def test_a_collision_setup_switches_other_geoms_off(spec):
    CollisionCfg(
        geom_names_expr=("foot",),
        contype=2,
        conaffinity={"foot_left": 4, ".*": 1},
        condim=6,
        priority={"foot_left": 1, "foot": 0},
        friction={"foot_right": (0.3, 0.1)},
    ).edit_spec(spec)
    model = spec.compile()
    assert model.geom_contype.tolist() == [2, 2, 0, 0]
    assert model.geom_conaffinity.tolist() == [4, 1, 0, 0]
    assert model.geom_condim.tolist() == [6, 6, 3, 3]
    assert model.geom_priority.tolist() == [1, 0, 0, 0]
    np.testing.assert_allclose(model.geom_friction[:, 0], [1.0, 0.3, 1.0, 1.0])


def test_a_collision_setup_can_leave_other_geoms_alone(spec):
    cfg = CollisionCfg(("foot",), contype=2, conaffinity=2, condim=1, priority=1)
    cfg.disable_other_geoms = False
    cfg.edit_spec(spec)
    assert spec.compile().geom_contype.tolist() == [2, 2, 1, 1]


def test_unmatched_geoms_get_the_defaults_with_one_warning(spec):
    for geom in spec.geoms:
        geom.condim, geom.priority, geom.contype, geom.conaffinity = 6, 2, 4, 8
    partial = {"foot_left": 4}
    cfg = CollisionCfg(
        (".*",), contype=partial, conaffinity=partial, condim=partial, priority=partial
    )
    with pytest.warns(UserWarning, match=r"no pattern matches.*'foot_right'.*\.\*") as record:
        cfg.edit_spec(spec)
    assert len(record) == 1
    model = spec.compile()
    assert model.geom_condim.tolist() == [4, 3, 3, 3]
    assert model.geom_priority.tolist() == [4, 0, 0, 0]
    assert model.geom_contype.tolist() == [4, 1, 1, 1]
    assert model.geom_conaffinity.tolist() == [4, 1, 1, 1]


def test_edits_that_a_fallback_overwrites_are_reported(spec):
    geom = GeomCfg(geom_names_expr=("foot_right",), condim=1)
    collision = CollisionCfg((".*",), **{**REQUIRED, "condim": {"foot_left": 4}})
    with pytest.warns(UserWarning, match=r"foot_right\.condim"):
        warn_overlapping_geom_edits([geom], [collision], spec)


def test_geoms_that_share_a_name_are_matched_together(spec):
    GeomCfg(geom_names_expr=("$",), group=2).edit_spec(spec)
    assert spec.compile().geom_group.tolist() == [0, 0, 0, 2]


def test_edits_that_will_be_overwritten_are_reported(spec):
    geom = GeomCfg(geom_names_expr=(".*",), condim={"foot": 1, "torso": 1}, contype=0, group=1)
    collision = CollisionCfg(geom_names_expr=("foot",), **REQUIRED)
    with pytest.warns(UserWarning, match="A CollisionCfg overwrites") as record:
        warn_overlapping_geom_edits([geom], [collision], spec)
    message = str(record[0].message)
    # Feet are overwritten, and contype of all other geoms, because the setup disables these.
    for name in ("foot_left.condim", "foot_left.contype", "torso.contype"):
        assert name in message
    assert "torso.condim" not in message
    assert "group" not in message


def test_edits_that_do_not_overlap_are_not_reported(spec):
    geom = GeomCfg(geom_names_expr=("torso",), condim=1)
    collision = CollisionCfg(geom_names_expr=("foot",), **REQUIRED)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_overlapping_geom_edits([geom], [collision], spec)


def test_a_drawn_texture_on_a_material_on_geoms(spec):
    TextureCfg(
        name="t",
        type="2d",
        builtin="checker",
        rgb1=(0.1, 0.2, 0.3),
        width=8,
        height=4,
        mark="edge",
        markrgb=(1, 0, 0),
    ).edit_spec(spec)
    MaterialCfg(
        name="m",
        texture="t",
        texrepeat=(2.5, 3.0),
        texuniform=True,
        reflectance=0.2,
        geom_names_expr=("foot",),
    ).edit_spec(spec)
    model = spec.compile()
    assert (model.tex_width[0], model.tex_height[0]) == (8, 4)
    rgb_role = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
    assert model.mat_texid[0, rgb_role] == 0
    np.testing.assert_allclose(model.mat_texrepeat[0], [2.5, 3.0])
    assert model.geom_matid.tolist() == [0, 0, -1, -1]


def test_a_skybox_from_a_gradient_and_a_cube_from_files():
    spec = mujoco.MjSpec()
    TextureCfg(name="s", type="skybox", builtin="gradient", width=8, height=8).edit_spec(spec)
    faces = tuple(f"{i}.png" for i in range(6))
    TextureCfg(name="c", type="cube", cubefiles=faces).edit_spec(spec)
    grid = TextureCfg("g", "skybox", file="g.png", gridsize=(3, 4), gridlayout=".U..LFRB.D..")
    grid.edit_spec(spec)
    assert spec.texture("s").type == mujoco.mjtTexture.mjTEXTURE_SKYBOX
    assert list(spec.texture("c").cubefiles) == list(faces)
    assert spec.texture("g").gridsize.tolist() == [3, 4]
    assert "".join(spec.texture("g").gridlayout) == ".U..LFRB.D.."


def test_an_unknown_builtin_image_is_an_error():
    with pytest.raises(ValueError, match=r"builtin.*\['none'.*'stripes'"):
        TextureCfg(name="t", type="2d", builtin="stripes").edit_spec(mujoco.MjSpec())  # ty: ignore


@pytest.mark.parametrize("count", [1, 7])
def test_a_cube_may_have_other_than_six_files(count):
    spec = mujoco.MjSpec()
    with pytest.warns(UserWarning, match=f"cubefiles: expected 6 files, got {count}"):
        TextureCfg(name="t", type="cube", cubefiles=("a.png",) * count).edit_spec(spec)
    assert [path for path in spec.texture("t").cubefiles if path] == ["a.png"] * min(count, 6)


@pytest.mark.parametrize("friction", [(), np.array([0.7, 0.1]), [0.7, 0.1]])
def test_friction_may_be_any_sequence(spec, friction):
    GeomCfg(geom_names_expr=(".*",), friction=friction).edit_spec(spec)
    expected = [0.7, 0.1] if len(friction) else [1.0, 0.005]
    np.testing.assert_allclose(spec.geoms[0].friction[:2], expected)


def test_meshes_get_their_hull_limit():
    spec = mujoco.MjSpec()
    for name in ("a", "b", "c"):
        spec.add_mesh(name=name)
    MeshCfg(mesh_names_expr=("a", "b"), maxhullvert={"a": 10, "b": -1}).edit_spec(spec)
    assert [mesh.maxhullvert for mesh in spec.meshes] == [10, -1, -1]
    with pytest.raises(ValueError, match=r"pattern 'b'.*-1 or .* > 3, got 3"):
        MeshCfg(mesh_names_expr=("b",), maxhullvert={"b": 3}).edit_spec(spec)


def test_lights_and_cameras_are_added_to_bodies(spec):
    LightCfg(name="sun", type="directional", diffuse=(0.1, 0.2, 0.3)).edit_spec(spec)
    LightCfg(body="base", mode="targetbody", target="base", castshadow=False).edit_spec(spec)
    CameraCfg(name="cam", body="base", fovy=30.0, pos=(1, 2, 3), quat=(0, 1, 0, 0)).edit_spec(spec)
    CameraCfg(name="tracking", mode="targetbodycom", target="base").edit_spec(spec)
    model = spec.compile()
    base = model.body("base").id
    assert model.light_bodyid.tolist() == [0, base]
    assert model.light_castshadow.tolist() == [True, False]
    assert model.light_targetbodyid.tolist() == [-1, base]
    np.testing.assert_allclose(model.light("sun").diffuse, (0.1, 0.2, 0.3))
    # Colors that are not given stay MuJoCo's.
    np.testing.assert_allclose(
        model.light_diffuse[1], mujoco.MjSpec().worldbody.add_light().diffuse
    )
    np.testing.assert_allclose(model.camera("cam").pos, (1, 2, 3))
    assert model.camera("cam").fovy == 30.0
    assert model.camera("tracking").targetbodyid == base


@pytest.mark.parametrize("cls", [LightCfg, CameraCfg])
def test_an_unknown_body_or_mode_is_refused_with_the_choices(spec, cls):
    with pytest.raises(ValueError, match=rf"{cls.__name__} body 'leg'.*\['world', 'base'\]"):
        cls(name="x", body="leg").edit_spec(spec)
    with pytest.raises(ValueError, match="body 'leg'"):
        cls(name="x", mode="targetbody", target="leg").edit_spec(spec)
    with pytest.raises(ValueError, match=r"mode.*\['fixed'.*'orbit'"):
        cls(name="x", mode="orbit").edit_spec(spec)
    with pytest.warns(UserWarning, match="no effect without `target`"):
        cls(name="aimless", mode="targetbody").edit_spec(spec)
