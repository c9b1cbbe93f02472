"""Randomization of joints."""

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
from mjlab.envs.mdp.dr.joint import normalize_ball_joints
from mjlab.managers.scene_entity_config import SceneEntityCfg

ENGINES = ("native", "warp")


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
    # A joint without limits keeps infinite limits; other joints and environments are unchanged.
    assert torch.isinf(data.joint_pos_limits[1, 2]).all()
    assert torch.equal(data.soft_joint_pos_limits[1, 1:], before[1, 1:])
    assert torch.equal(data.soft_joint_pos_limits[0], before[0])


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
