"""Targets after a reset: position actuators hold, others rest."""

from __future__ import annotations

import mujoco
import pytest
import torch

from mjlab.actuator import (
    BuiltinPositionActuatorCfg,
    BuiltinVelocityActuatorCfg,
    DcMotorActuatorCfg,
    IdealPdActuatorCfg,
    TransmissionType,
    XmlActuatorCfg,
)
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg, mdp
from mjlab.managers import EventTermCfg
from mjlab.scene import SceneCfg

GRIPPER = """
<mujoco><worldbody>{body}
  <geom name="palm" size=".05" mass="1"/>
  <body name="l"><joint name="f1" type="slide" axis="0 1 0" damping="5"/>
    <geom size=".01" mass=".02" contype="0" conaffinity="0"/></body>
  <body name="r"><joint name="f2" type="slide" axis="0 -1 0" damping="5"/>
    <geom size=".01" mass=".02" contype="0" conaffinity="0"/><site name="tip"/></body>
</body></worldbody>
<tendon><fixed name="split"><joint joint="f1" coef=".5"/><joint joint="f2" coef=".5"/></fixed></tendon>
<actuator>{actuators}</actuator>{key}</mujoco>
"""
BASES = {"fixed": '<body pos="0 0 1">', "floating": '<body pos="0 0 1"><freejoint/>'}
ENGINES = ("native", "warp")
TENDON = {"target_names_expr": ("split",), "transmission_type": TransmissionType.TENDON}
PD = {"stiffness": 100.0, "damping": 5.0}


def make_env(
    actuators="", configs=(), base="floating", engine="native", num_envs=2, opened=0.04, **kw
):
    key, init = kw.pop("key", ""), EntityCfg.InitialStateCfg(pos=(0.0, 0.0, 1.0))
    init.joint_pos = None if key else {".*": opened}
    xml = GRIPPER.format(body=BASES[base], actuators=actuators, key=key)
    articulation = EntityArticulationInfoCfg(actuators=configs) if configs else None
    robot = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_string(xml), init_state=init, articulation=articulation
    )
    cfg = ManagerBasedRlEnvCfg(
        decimation=4,
        scene=SceneCfg(num_envs=num_envs, entities={"robot": robot}),
        observations={},
        events={"start": EventTermCfg(func=mdp.reset_scene_to_default, mode="reset"), **kw},
        episode_length_s=10.0,
    )
    cfg.sim.mujoco.gravity = (0.0, 0.0, 0.0)
    cfg.sim.engine = engine
    return ManagerBasedRlEnv(cfg, device="cpu")


def run(env, steps=20) -> torch.Tensor:
    for _ in range(steps):
        env.step(torch.zeros(env.num_envs, 0))
    return env.scene["robot"].data.joint_pos


def open_wider(env, env_ids):
    positions = 0.01 * (1.0 + env_ids.float())[:, None].repeat(1, 2)
    env.scene["robot"].write_joint_position_to_sim(positions, env_ids=env_ids)


# Value of the control, or of the activation, that holds a finger, or both, at 0.04 m.
UNLISTED = {
    '<position joint="f1" kp="100"/>': ("ctrl", 0.04),
    '<position joint="f1" kp="100" gear="2"/>': ("ctrl", 0.08),
    '<position tendon="split" kp="100"/>': ("ctrl", 0.04),
    '<general tendon="split" gainprm=".4" biasprm="0 -100 -10" biastype="affine"/>': ("ctrl", 10.0),
    '<intvelocity joint="f1" kp="100" actrange="-1 1"/>': ("act", 0.04),
    '<position joint="f1" kp="100" timeconst=".1"/>': ("act", 0.04),
}


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("actuator", UNLISTED)
def test_actuators_without_a_config_hold(actuator, engine):
    env = make_env(actuator, engine=engine)
    env.reset()
    field, value = UNLISTED[actuator]
    held = getattr(env.sim.data, field).clone()
    torch.testing.assert_close(held, torch.full((2, 1), value), rtol=0.0, atol=1e-5)
    torch.testing.assert_close(run(env), torch.full((2, 2), 0.04), rtol=0.0, atol=1e-4)
    env.close()


@pytest.mark.parametrize("actuator", ['<velocity joint="f1" kv="1"/>', '<motor tendon="split"/>'])
def test_other_actuators_without_a_config_rest(actuator):
    env = make_env(actuator)
    env.reset()
    assert not env.sim.data.ctrl.any()
    env.close()


LISTED = {
    "position": BuiltinPositionActuatorCfg(**TENDON, **PD),
    "delayed": BuiltinPositionActuatorCfg(**TENDON, **PD, delay_min_lag=1, delay_max_lag=3),
    "pd": IdealPdActuatorCfg(**TENDON, **PD, effort_limit=100.0),
    "delayed pd": IdealPdActuatorCfg(**TENDON, **PD, delay_min_lag=3, delay_max_lag=3),
    "dc": DcMotorActuatorCfg(
        **TENDON, **PD, effort_limit=9.0, saturation_effort=9.0, velocity_limit=9.0
    ),
    "xml": XmlActuatorCfg(**TENDON),
}


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("kind", LISTED)
def test_tendon_targets_hold(kind, base, engine):
    xml = '<position tendon="split" kp="100"/>' if kind == "xml" else ""
    env = make_env(xml, (LISTED[kind],), base, engine)
    env.reset()
    data = env.scene["robot"].data
    torch.testing.assert_close(data.tendon_len_target, torch.full((2, 1), 0.04))
    assert not data.tendon_vel_target.any()
    assert not data.tendon_effort_target.any()
    torch.testing.assert_close(run(env), torch.full((2, 2), 0.04), rtol=0.0, atol=1e-4)
    env.close()


@pytest.mark.parametrize("engine", ENGINES)
def test_partial_reset_holds_the_positions_of_events(engine):
    configs = (
        BuiltinPositionActuatorCfg(**TENDON, **PD),
        BuiltinVelocityActuatorCfg(target_names_expr=("f2",), damping=1.0),
    )
    env = make_env(
        '<position joint="f1" kp="100"/>', configs, engine=engine, num_envs=3,
        wider=EventTermCfg(func=open_wider, mode="reset"),
    )  # fmt: skip
    env.reset()
    data, ctrl = env.scene["robot"].data, env.sim.data.ctrl
    expected = torch.tensor([[0.01], [0.02], [0.03]])
    torch.testing.assert_close(data.tendon_len_target, expected)
    # XML actuators come first.
    torch.testing.assert_close(ctrl[:, :2].clone(), expected.repeat(1, 2))
    data.tendon_len_target.fill_(0.5)
    ctrl.fill_(0.5)
    env.reset(env_ids=torch.tensor([1]))
    expected = torch.tensor([[0.5], [0.02], [0.5]])
    torch.testing.assert_close(data.tendon_len_target, expected)
    torch.testing.assert_close(ctrl[:, :2].clone(), expected.repeat(1, 2))
    assert data.joint_vel_target[1].eq(0.0).all()
    env.close()


def test_keyframe_of_the_xml_holds():
    key = '<keyframe><key name="home" qpos="0 0 1 1 0 0 0 .03 .03" ctrl=".03"/></keyframe>'
    env = make_env('<position tendon="split" kp="100"/>', key=key)
    env.reset()
    torch.testing.assert_close(env.sim.data.ctrl.clone(), torch.full((2, 1), 0.03))
    torch.testing.assert_close(run(env), torch.full((2, 2), 0.03), rtol=0.0, atol=1e-4)
    env.close()


@pytest.mark.parametrize("engine", ENGINES)
def test_controls_of_the_keyframe_start_episodes(engine):
    key = '<keyframe><key qpos="0 0 1 1 0 0 0 .03 .03" ctrl=".5 .02 0"/></keyframe>'
    actuators = '<motor joint="f1"/><position joint="f2" kp="1"/><position joint="f1" kp="1"/>'
    env = make_env(actuators, key=key, engine=engine)
    env.reset()
    expected = torch.tensor([[0.5, 0.02, 0.03]] * 2)
    torch.testing.assert_close(env.sim.data.ctrl.clone(), expected)
    env.sim.data.ctrl[:] = 0.7
    env.reset(env_ids=torch.tensor([1]))
    torch.testing.assert_close(env.sim.data.ctrl[1].clone(), expected[1])
    assert env.sim.data.ctrl[0].eq(0.7).all()
    env.close()


def test_targets_of_reset_events_stay():
    def close(env, env_ids):
        env.sim.data.ctrl[env_ids] = 0.01

    env = make_env('<position joint="f1" kp="1"/>', hand=EventTermCfg(func=close, mode="reset"))
    env.reset()
    torch.testing.assert_close(env.sim.data.ctrl.clone(), torch.full((2, 1), 0.01))
    env.close()
