"""What single functions do beyond writing a field."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import pytest
import torch

from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.envs.mdp import dr, observations
from mjlab.envs.mdp.actions import JointPositionActionCfg
from mjlab.envs.mdp.dr._core import DOF, QPOS, Selection, select
from mjlab.envs.mdp.dr._hooks import normalize_ball_joints
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg

ENGINES = ("native", "warp")
PRIMITIVES = ("box", "sphere", "capsule", "cylinder", "ellipsoid")


# geom_size


@pytest.mark.parametrize("engine", ENGINES)
def test_geom_size_keeps_bounds_that_the_compiler_would_compute(
    make_world: Any, engine: str
) -> None:
    world = make_world(engine=engine)
    chosen = SceneEntityCfg("robot", geom_names=PRIMITIVES)
    world.apply(dr.geom_size, ranges=(1.0, 1.0), asset_cfg=chosen)
    primitives = world.sim.mj_model.geom_type != mujoco.mjtGeom.mjGEOM_MESH
    for field in ("geom_size", "geom_rbound", "geom_aabb"):
        default = world.sim.get_default_field(field)[primitives]
        now = getattr(world.sim.model, field)[:, primitives]
        torch.testing.assert_close(now, default.expand_as(now), msg=field)
    world.apply(dr.geom_size, torch.tensor([0]), ranges=(2.0, 2.0), asset_cfg=chosen)
    for field, factor in (("geom_rbound", 2.0), ("geom_aabb", 2.0)):
        default = world.sim.get_default_field(field)[primitives]
        torch.testing.assert_close(
            getattr(world.sim.model, field)[0, primitives], factor * default, msg=field
        )
        torch.testing.assert_close(getattr(world.sim.model, field)[1, primitives], default)


def test_geom_size_checks_before_it_writes(make_world: Any) -> None:
    world = make_world()
    with pytest.raises(ValueError, match=r"no primitives: \{'tetra': 'mesh'\}"):
        world.apply(dr.geom_size, ranges=(2.0, 2.0))
    with pytest.raises(ValueError, match="tetra"):
        world.apply(dr.geom_size, ranges={"box": (2.0, 2.0), "tetra": (2.0, 2.0)})
    default = world.sim.get_default_field("geom_size")
    assert torch.equal(world.sim.model.geom_size, default.expand(4, *default.shape))


def test_geom_size_with_patterns_leaves_other_geoms_alone(make_world: Any) -> None:
    # The selection of the config has a mesh, which the patterns leave out.
    world = make_world()
    world.apply(dr.geom_size, ranges={"sphere": (3.0, 3.0)})
    assert world.sim.model.geom_rbound[0, 1] == pytest.approx(0.3)
    assert world.sim.model.geom_rbound[0, 0] == pytest.approx(world.sim.mj_model.geom_rbound[0])


def test_geom_size_bounds_are_those_of_their_own_environment_and_geom(make_world: Any) -> None:
    """More geoms than environments, of types in turn, and a part of both: no grid fits by luck."""
    xml = (
        """<mujoco><worldbody><body name="b"><freejoint/>"""
        + "".join(
            f'<geom name="{kind}{k}" type="{kind}" size=".1 .2 .3"/>'
            for k in range(2)
            for kind in PRIMITIVES
        )
        + "</body></worldbody></mujoco>"
    )
    world = make_world(xml, num_envs=5)
    model, envs = world.sim.model, torch.tensor([1, 3, 4])
    chosen = SceneEntityCfg("robot", geom_names=("sphere.", "box1", "capsule.", "ellipsoid0"))
    world.apply(dr.geom_size, envs, ranges=(0.5, 2.0), asset_cfg=chosen)
    changed = model.geom_size != world.sim.get_default_field("geom_size")
    assert changed.any(dim=2).sum(dim=1).tolist() == [0, 6, 0, 6, 6]
    for env in range(5):
        spec = mujoco.MjSpec.from_string(xml)
        for geom in range(10):
            spec.geoms[geom].size = model.geom_size[env, geom].double()
        built = spec.compile()
        for field in ("geom_rbound", "geom_aabb"):
            expected = torch.as_tensor(getattr(built, field)).float()
            now = getattr(model, field)[env].reshape(expected.shape)
            torch.testing.assert_close(now, expected, msg=f"{field} of environment {env}")


# joint_limits


def test_joint_limits_refresh_the_limits_of_the_entity(make_world: Any) -> None:
    world = make_world()
    before = world.robot.data.soft_joint_pos_limits.clone()
    world.apply(
        dr.joint_limits,
        torch.tensor([1]),
        ranges={0: (-0.5, -0.5), 1: (0.1, 0.1)},
        asset_cfg=SceneEntityCfg("robot", joint_names=("hip", "ankle")),
    )
    data = world.robot.data
    torch.testing.assert_close(data.joint_pos_limits[1, 0], torch.tensor([-0.5, 0.1]))
    # The soft limits shrink by the configured factor, 0.9, about the middle.
    torch.testing.assert_close(data.soft_joint_pos_limits[1, 0], torch.tensor([-0.47, 0.07]))
    # A joint without limits stays without; other joints and environments stay as they were.
    assert torch.isinf(data.joint_pos_limits[1, 2]).all()
    assert torch.equal(data.soft_joint_pos_limits[1, 1:], before[1, 1:])
    assert torch.equal(data.soft_joint_pos_limits[0], before[0])


# light_dir


@pytest.mark.parametrize("engine", ENGINES)
def test_light_directions_have_length_one(make_world: Any, engine: str) -> None:
    world = make_world(engine=engine)
    for _ in range(3):
        world.apply(dr.light_dir, ranges={0: (2.0, 3.0)})
        direction = world.sim.model.light_dir
        torch.testing.assert_close(direction.norm(dim=-1), torch.ones(4, 1))
        # Starting from the default (0, 0, -1) each time, x / z stays in the range.
        ratio = -direction[..., 0] / direction[..., 2]
        assert bool(((ratio >= 1.999) & (ratio <= 3.001)).all())


def test_a_zero_light_direction_is_refused(make_world: Any) -> None:
    with pytest.raises(ValueError, match="light_dir: a zero vector"):
        make_world().apply(dr.light_dir, ranges=(0.0, 0.0))


# Addresses of joints


BALL_XML = """
<mujoco><worldbody>
  <body><joint name="ball" type="ball"/><geom size=".1"/>
    <body pos="0 0 .5"><joint name="hinge"/><geom size=".1"/></body>
  </body>
</worldbody></mujoco>
"""


def _ball_env() -> Any:
    model = mujoco.MjModel.from_xml_string(BALL_XML)
    indexing = SimpleNamespace(joint_ids=torch.tensor([0, 1], dtype=torch.int32))
    entity = SimpleNamespace(joint_names=("ball", "hinge"), data=SimpleNamespace(indexing=indexing))
    qpos0 = torch.from_numpy(model.qpos0).float().repeat(2, 1)
    sim = SimpleNamespace(mj_model=model, model=SimpleNamespace(qpos0=qpos0))
    return SimpleNamespace(num_envs=2, device="cpu", scene={"robot": entity}, sim=sim)


def test_joints_after_a_ball_joint_have_their_own_addresses() -> None:
    env = _ball_env()
    hinge = SceneEntityCfg("robot", joint_ids=[1])
    assert select(env, None, hinge, DOF).columns.tolist() == [3]
    assert select(env, None, hinge, QPOS).columns.tolist() == [4]
    both = SceneEntityCfg("robot")
    assert select(env, None, both, DOF).columns.tolist() == [0, 1, 2, 3]
    assert select(env, None, both, QPOS).columns.tolist() == [0, 1, 2, 3, 4]
    assert select(env, None, both, DOF, pattern="ball").columns.tolist() == [0, 1, 2]


def test_ball_joints_keep_unit_quaternions() -> None:
    env = _ball_env()
    selection: Selection = select(env, torch.tensor([1]), SceneEntityCfg("robot"), QPOS)
    env.sim.model.qpos0[1] = torch.tensor([2.0, 0.0, 0.0, 0.0, 5.0])
    normalize_ball_joints(selection)
    assert env.sim.model.qpos0[1].tolist() == [1.0, 0.0, 0.0, 0.0, 5.0]
    assert env.sim.model.qpos0[0].tolist() == [1.0, 0.0, 0.0, 0.0, 0.0]


def test_free_joints_do_not_count_among_dofs(make_world: Any) -> None:
    world = make_world()
    world.apply(dr.joint_armature, ranges=(0.7, 0.7))
    armature = world.sim.model.dof_armature
    assert bool((armature[:, :6] == 0.0).all())
    assert bool((armature[:, 6:] == 0.7).all())


def test_joint_default_pos_shifts_the_zero_and_keeps_the_defaults(make_world: Any) -> None:
    world = make_world()
    world.apply(
        dr.joint_default_pos,
        ranges=(0.2, 0.2),
        asset_cfg=SceneEntityCfg("robot", joint_names=("hip",)),
    )
    assert bool((world.sim.model.qpos0[:, 7] == 0.2).all())
    assert bool((world.sim.model.qpos0[:, 8:] == 0.0).all())
    assert bool((world.robot.data.default_joint_pos == 0.0).all())
    # The leg hangs straight where the joint position equals its new zero.
    world.sim.data.qpos[:, 7] = 0.2
    world.sim.forward()
    torch.testing.assert_close(
        world.sim.data.xmat[:, 2], world.sim.data.xmat[:, 1], atol=1e-6, rtol=0
    )


# encoder_bias


@pytest.mark.parametrize("engine", ENGINES)
def test_encoder_bias_is_seen_by_actions_and_by_observations_alike(
    make_world: Any, engine: str
) -> None:
    """A robot that has reached its target senses the position that it was told, bias or not."""
    servo = BuiltinPositionActuatorCfg(
        target_names_expr=("hip", "knee", "ankle"), stiffness=5e3, damping=50.0
    )
    world = make_world(engine=engine, actuators=(servo,))
    world.apply(dr.encoder_bias, bias_range=(-0.2, 0.2))
    bias = world.robot.data.encoder_bias
    assert len(bias.unique()) == bias.numel()
    world.robot.data.default_joint_pos[:] = torch.tensor([0.1, -0.2, 0.05])
    cfg = JointPositionActionCfg(entity_name="robot", actuator_names=(".*",), scale=0.5)
    term, action = cfg.build(world), torch.tensor([[0.2, -0.1, 0.3]]).expand(4, 3)
    term.process_actions(action)
    for _ in range(100):
        term.apply_actions()
        world.robot.write_data_to_sim()
        world.sim.step()
    sensed = observations.joint_pos_rel(world, biased=True)
    torch.testing.assert_close(sensed, 0.5 * action, atol=5e-3, rtol=0)
    # The joints themselves are elsewhere, by the bias.
    true = observations.joint_pos_rel(world)
    torch.testing.assert_close(true, 0.5 * action - bias, atol=5e-3, rtol=0)


def test_encoder_bias_is_replaced_and_survives_resets(make_world: Any) -> None:
    world = make_world()
    knee = SceneEntityCfg("robot", joint_names=("knee",))
    for low in (0.1, 0.3):
        world.apply(dr.encoder_bias, bias_range=(low, low + 0.01), asset_cfg=knee)
    world.robot.reset(None)
    bias = world.robot.data.encoder_bias
    assert bool(((bias[:, 1] >= 0.3) & (bias[:, 1] <= 0.31)).all())
    assert len(bias[:, 1].unique()) == 4
    assert bool((bias[:, [0, 2]] == 0.0).all())


# Cameras

CAMERAS_XML = """
<mujoco><worldbody><body name="head"><joint name="neck"/><geom size=".1"/>
  <camera name="plain" fovy="60"/>
  <camera name="map" fovy="2" projection="orthographic"/>
  <camera name="lens" focal=".01 .01" sensorsize=".02 .02" resolution="8 8"/>
</body></worldbody></mujoco>
"""


@pytest.mark.parametrize(
    "params",
    [
        {"ranges": (40.0, 50.0)},
        {"ranges": (40.0, 50.0), "asset_cfg": SceneEntityCfg("robot", camera_names=("lens",))},
        {"ranges": {"plain": (40.0, 50.0), "le.*": (50.0, 60.0)}},
    ],
    ids=["all", "selected", "by pattern"],
)
def test_cam_fovy_refuses_cameras_that_do_not_read_it_when_it_is_built(
    make_world: Any, params: dict[str, Any]
) -> None:
    world = make_world(CAMERAS_XML)
    term = EventTermCfg(func=dr.cam_fovy, mode="reset", params=params)
    with pytest.raises(ValueError, match=r"'zoom'.*focal length.*\['lens'\].*dr\.cam_intrinsic"):
        world.events(zoom=term)


def test_cam_fovy_is_for_cameras_that_read_it(make_world: Any) -> None:
    world = make_world(CAMERAS_XML)
    chosen = SceneEntityCfg("robot", camera_names=("plain", "map"))
    params = {"ranges": (40.0, 50.0), "asset_cfg": chosen}
    manager = world.events(zoom=EventTermCfg(func=dr.cam_fovy, mode="startup", params=params))
    manager.apply("startup")
    fovy = world.sim.model.cam_fovy
    assert bool(((fovy[:, :2] >= 40.0) & (fovy[:, :2] <= 50.0)).all())
    assert torch.equal(fovy[:, 2], world.sim.get_default_field("cam_fovy")[2].expand(4))


# Materials, textures, pairs


@pytest.mark.parametrize("engine", ENGINES)
def test_geom_matid_chooses_among_the_selected_materials(make_world: Any, engine: str) -> None:
    world = make_world(engine=engine, num_envs=16)
    chosen = SceneEntityCfg("robot", geom_names=("box", "sphere"), material_names=("mat_.*",))
    world.apply(dr.geom_matid, asset_cfg=chosen)
    ids = world.sim.model.geom_matid
    assert sorted(ids[:, :2].unique().tolist()) == [0, 1]
    assert bool((ids[:, 2:] == -1).all())
    world.apply(dr.geom_matid, asset_cfg=chosen, shared_random=True)
    assert torch.equal(ids[:, 0], ids[:, 1])


def test_an_empty_choice_is_refused(make_world: Any) -> None:
    with pytest.raises(ValueError, match="No material to choose from"):
        make_world().apply(dr.geom_matid, asset_cfg=SceneEntityCfg("robot", material_names=()))


def test_mat_texid_writes_one_role(make_world: Any) -> None:
    world = make_world(num_envs=16)
    chosen = SceneEntityCfg("robot", material_names=("mat_b",), texture_names=("tex_.*",))
    world.apply(dr.mat_texid, asset_cfg=chosen)
    ids = world.sim.model.mat_texid
    rgb = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
    assert sorted(ids[:, 1, rgb].unique().tolist()) == [0, 1]
    others = [role for role in range(ids.shape[-1]) if role != rgb]
    assert bool((ids[:, 1, others] == -1).all())
    with pytest.raises(ValueError, match="role 99 does not exist"):
        world.apply(dr.mat_texid, asset_cfg=chosen, role=99)


def test_isotropic_pair_friction_mirrors_what_was_written(make_world: Any) -> None:
    world = make_world()
    default = world.sim.get_default_field("pair_friction")
    world.apply(dr.pair_friction, torch.tensor([0, 1]), ranges=(0.3, 0.6), isotropic=True)
    friction = world.sim.model.pair_friction
    assert torch.equal(friction[:2, :, 1], friction[:2, :, 0])
    assert torch.equal(friction[:2, :, 2:], default[:, 2:].expand(2, 1, 3))
    assert torch.equal(friction[2:], default.expand(2, 1, 5))
    # Also where patterns choose the pairs.
    world.apply(dr.pair_friction, ranges={"self": {3: (0.1, 0.2)}}, isotropic=True)
    assert torch.equal(friction[..., 4], friction[..., 3])
