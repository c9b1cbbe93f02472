"""Actuators with several controls or forces: `<pid>`, `<dcmotor>`, `<orientation>`."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from mjlab.actuator import (
    BuiltinPositionActuatorCfg,
    IdealPdActuatorCfg,
    TransmissionType,
    XmlActuatorCfg,
)
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg, VariantEntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg, mdp
from mjlab.managers import EventTermCfg, ObservationGroupCfg, ObservationTermCfg, SceneEntityCfg
from mjlab.rl.exporter_utils import get_base_metadata
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import MujocoCfg, Simulation, SimulationCfg
from mjlab.sim.engine import EngineUnavailableError

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="base" pos="0 0 1">
      <geom size=".05" mass="1"/>
      <body name="upper">
        <joint name="hip" axis="0 1 0" damping="1"/>
        <geom size=".05" pos=".2 0 0" mass="1"/>
        <body name="lower" pos=".4 0 0">
          <joint name="knee" axis="0 1 0" range="-2 2" damping="1"/>
          <geom size=".05" pos=".2 0 0" mass="1"/>
          <body name="foot" pos=".4 0 0">
            <joint name="ankle" axis="0 1 0" damping="1"/>
            <geom size=".05" pos=".1 0 0" mass="1"/>
            <site name="toe" pos=".2 0 0"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>
"""
# Three controls and three forces, of an actuator that no config lists.
TURN = '<orientation name="turn" site="toe" refsite="toe" kp="0"/>'
PID = '<pid name="hip" joint="hip" kp="60" kv="4" input="pos vel"/>'
DC = (
    '<dcmotor name="hip" joint="hip" input="pos vel" motorconst=".5" resistance="1"'
    ' controller="60 0 4"/>'
)
SERVO = '<position name="ankle" joint="ankle" kp="30" kv="2" ctrlrange="-3 3"/>'
KNEE = BuiltinPositionActuatorCfg(target_names_expr=("knee",), stiffness=40.0, damping=3.0)
XML = tuple(XmlActuatorCfg(target_names_expr=(name,)) for name in ("hip", "ankle"))

NUM_ENVS = 3
TARGET = torch.tensor([0.3, -0.4, 0.5])


def make_env(xml: str, actuators: tuple[Any, ...] = (*XML, KNEE), engine: Any = "native") -> Any:
    cfg = ManagerBasedRlEnvCfg(
        decimation=5,
        scene=SceneCfg(
            num_envs=NUM_ENVS,
            entities={
                "robot": EntityCfg(
                    spec_fn=lambda: mujoco.MjSpec.from_string(xml),
                    articulation=EntityArticulationInfoCfg(actuators=actuators),
                )
            },
        ),
        observations={
            "actor": ObservationGroupCfg(terms={"q": ObservationTermCfg(func=mdp.joint_pos_rel)})
        },
        actions={
            "joints": mdp.JointPositionActionCfg(entity_name="robot", actuator_names=(".*",)),
        },
        sim=SimulationCfg(engine=engine, mujoco=MujocoCfg(timestep=0.004)),
        seed=0,
    )
    return ManagerBasedRlEnv(cfg, device="cpu")


def plain_loop(env: Any, controls: dict[str, list[float]], steps: int) -> np.ndarray:
    model = env.sim.mj_model
    data = mujoco.MjData(model)
    for name, values in controls.items():
        actuator = model.actuator(f"robot/{name}").id
        start = model.actuator_ctrladr[actuator]
        data.ctrl[start : start + model.actuator_ctrlnum[actuator]] = values
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return data.qpos


@pytest.mark.parametrize(
    ("engine", "xml"),
    [
        ("native", TURN + PID + SERVO),
        pytest.param("native", TURN + DC + SERVO, marks=pytest.mark.slow),
        pytest.param("warp", DC + SERVO, marks=pytest.mark.slow),
    ],
    ids=("native-pid", "native-dcmotor", "warp-dcmotor"),
)
def test_joint_position_action_drives_the_same_joints_as_a_plain_loop(engine, xml):
    env = make_env(ARM.format(actuators=xml), engine=engine)
    env.reset()
    assert env.scene["robot"].joint_names == ("hip", "knee", "ankle")
    for _ in range(4):
        env.step(TARGET.repeat(NUM_ENVS, 1))
    hip, knee, ankle = TARGET.tolist()
    expected = plain_loop(env, {"hip": [hip, 0.0], "knee": [knee], "ankle": [ankle]}, 20)
    np.testing.assert_allclose(env.sim.data.qpos[1].numpy(), expected, atol=2e-5)
    env.close()


def test_every_input_takes_its_own_target_whatever_the_order_in_the_xml(make_world):
    pid = '<pid name="{0}" joint="{0}" kp="9" kv="1" input="pos vel ff"/>'
    extra = (
        f"<actuator>{pid.format('knee')}<position joint='ankle' kp='3'/>{pid.format('hip')}"
        "</actuator>"
    )
    world = make_world(
        XmlActuatorCfg(target_names_expr=("hip", "knee")),
        XmlActuatorCfg(target_names_expr=("ankle",)),
        extra=extra,
    )
    robot = world.entity
    robot.set_joint_position_target(torch.tensor([[1.0, 2.0, 3.0]]))
    robot.set_joint_velocity_target(torch.tensor([[4.0, 5.0, 6.0]]))
    robot.set_joint_effort_target(torch.tensor([[7.0, 8.0, 9.0]]))
    robot.write_data_to_sim()
    assert world.ctrl.tolist() == [[2.0, 5.0, 8.0, 3.0, 1.0, 4.0, 7.0]] * 3
    pids, servo = robot.actuators
    assert pids.command_fields == ("position", "velocity", "effort")
    assert pids.global_ctrl_ids.tolist() == [4, 0, 5, 1, 6, 2]
    assert pids.global_element_ids.tolist() == [2, 0]
    assert servo.global_ctrl_ids.tolist() == [3]


def test_delayed_commands_reach_every_input(make_world):
    world = make_world(
        XmlActuatorCfg(target_names_expr=("hip",), delay_min_lag=1, delay_max_lag=1),
        extra='<actuator><motor joint="knee"/><pid joint="hip" kp="9" kv="1"/></actuator>',
    )
    robot = world.entity
    for value in (1.0, 2.0):
        robot.set_joint_position_target(torch.full((3, 3), value))
        robot.set_joint_velocity_target(torch.full((3, 3), 10 * value))
        robot.write_data_to_sim()
    assert world.ctrl.tolist() == [[0.0, 1.0, 10.0]] * 3


def test_forces_are_those_of_the_entity_and_its_selected_actuators():
    env = make_env(ARM.format(actuators=TURN + PID + SERVO))
    env.reset()
    env.step(TARGET.repeat(NUM_ENVS, 1))
    model, data = env.sim.mj_model, env.scene["robot"].data
    assert data.actuator_force.shape == (NUM_ENVS, model.nout) == (NUM_ENVS, 6)
    assert env.scene["robot"].actuator_names == ("turn", "hip", "ankle", "knee")
    chosen = SceneEntityCfg("robot", actuator_names=("hip", "knee"))
    chosen.resolve(env.scene)
    expected = env.sim.data.actuator_force[:, [3, 5]].square().sum(dim=1)
    assert expected.min() > 0
    assert torch.equal(mdp.joint_torques_l2(env, asset_cfg=chosen), expected)
    for ids in (torch.tensor([1, 3]), torch.tensor([False, True, False, True]), slice(1, 4, 2)):
        assert data.indexing.force_columns(ids) == [3, 5]
    env.close()


@pytest.mark.parametrize(
    ("names", "columns"),
    [(("turn",), [0, 1, 2]), (("ankle",), [5]), (("hip", "ankle"), [3, 4, 5]), ((".*",), range(7))],
)
@pytest.mark.parametrize("as_ids", [list, torch.tensor, "mask", "slice"])
def test_controls_are_written_to_the_actuators_that_are_found(names, columns, as_ids):
    env = make_env(ARM.format(actuators=TURN + PID + SERVO))
    env.reset()
    robot = env.scene["robot"]
    ids, _ = robot.find_actuators(names)
    if as_ids == "mask":
        chosen = torch.isin(torch.arange(4), torch.tensor(ids))
    else:
        chosen = slice(ids[0], ids[-1] + 1) if as_ids == "slice" else as_ids(ids)
    before = env.sim.data.ctrl.clone()
    values = torch.arange(1.0, len(columns) + 1)
    robot.write_ctrl_to_sim(values.repeat(NUM_ENVS, 1), ctrl_ids=chosen)
    before[:, list(columns)] = values
    assert torch.equal(env.sim.data.ctrl, before)
    assert robot.indexing.ctrl_ids.tolist() == list(range(7))
    env.close()


def test_controls_of_another_width_than_the_actuators_have_raise():
    env = make_env(ARM.format(actuators=TURN + PID + SERVO))
    robot = env.scene["robot"]
    with pytest.raises(ValueError, match=r"3\), got 2 values"):
        robot.write_ctrl_to_sim(torch.zeros(NUM_ENVS, 2), ctrl_ids=[0])
    with pytest.raises(IndexError):
        robot.write_ctrl_to_sim(torch.zeros(NUM_ENVS, 1), ctrl_ids=[4])
    env.close()


def test_ids_of_an_actuator_object_are_those_of_its_elements_in_the_entity():
    env = make_env(ARM.format(actuators=TURN + PID + SERVO))
    robot = env.scene["robot"]
    for actuator, names in zip(robot.actuators, (["hip"], ["ankle"], ["knee"]), strict=True):
        assert actuator.ctrl_ids.tolist() == robot.find_actuators(names)[0]
    hip = robot.actuators[0]
    robot.write_ctrl_to_sim(torch.tensor([[1.0, 2.0]]), ctrl_ids=hip.ctrl_ids)
    assert env.sim.data.ctrl[:, hip.global_ctrl_ids].tolist() == [[1.0, 2.0]] * NUM_ENVS
    env.close()


def test_the_initial_keyframe_holds_joints_by_the_position_input():
    entity = EntityCfg(
        init_state=EntityCfg.InitialStateCfg(joint_pos={"hip": 0.1, "ankle": 0.3}),
        spec_fn=lambda: mujoco.MjSpec.from_string(ARM.format(actuators=TURN + PID + SERVO)),
        articulation=EntityArticulationInfoCfg(actuators=(*XML, KNEE)),
    ).build()
    np.testing.assert_allclose(entity.compile().key_ctrl[0], [0, 0, 0, 0.1, 0, 0.3, 0])


def test_gains_are_randomized_in_their_rows():
    ideal = IdealPdActuatorCfg(
        target_names_expr=("knee",), stiffness=40.0, damping=3.0, effort_limit=20.0
    )
    cfg = make_env(ARM.format(actuators=TURN + PID + SERVO), (*XML, ideal)).cfg
    for name, func, ranges in (
        ("gains", mdp.dr.pd_gains, {"kp_range": (2.0, 2.0), "kd_range": (3.0, 3.0)}),
        ("limits", mdp.dr.effort_limits, {"effort_limit_range": (0.5, 0.5)}),
    ):
        cfg.events[name] = EventTermCfg(func=func, mode="startup", params=ranges)
    cfg.events["limits"].params["asset_cfg"] = SceneEntityCfg("robot", actuator_names=("knee",))
    env = ManagerBasedRlEnv(cfg, device="cpu")
    before, model = env.sim.mj_model, env.sim.model
    hip, ankle, knee = (before.actuator(f"robot/{name}").id for name in ("hip", "ankle", "knee"))
    assert torch.allclose(model.actuator_biasprm[:, hip, :3], torch.tensor([0.0, -120.0, -12.0]))
    assert torch.allclose(model.actuator_gainprm[:, hip], torch.zeros(1))
    assert torch.allclose(model.actuator_biasprm[:, ankle, :3], torch.tensor([0.0, -60.0, -6.0]))
    control = before.actuator_ctrladr[knee]
    assert control == before.nu - 1 > knee
    limit = torch.tensor([-10.0, 10.0])
    assert torch.allclose(model.actuator_ctrlrange[:, control], limit)
    assert torch.allclose(model.actuator_forcerange[:, knee], limit)
    # Actuators that no event selects keep their range.
    servo = torch.tensor([-3.0, 3.0])
    assert torch.allclose(model.actuator_ctrlrange[:, before.actuator_ctrladr[ankle]], servo)
    env.close()


def test_exported_gains_are_those_of_each_joints_actuator():
    env = make_env(ARM.format(actuators=TURN + PID + SERVO))
    metadata = get_base_metadata(env, "run")
    assert metadata["joint_stiffness"] == [60.0, 40.0, 30.0]
    assert metadata["joint_damping"] == [4.0, 3.0, 2.0]
    env.close()


def test_an_orientation_cannot_follow_targets_and_says_what_to_use(make_world):
    with pytest.raises(ValueError, match=r"orientation on 'turn'; .*write_ctrl_to_sim"):
        make_world(
            XmlActuatorCfg(target_names_expr=("toe",), transmission_type=TransmissionType.SITE),
            extra=f"<actuator>{TURN}</actuator>",
        )


@pytest.mark.parametrize(("element", "kind"), [(PID, "(?i)pid"), (TURN, "orientation|SO3")])
def test_warp_names_unsupported_actuators(element, kind):
    with pytest.raises(EngineUnavailableError, match=kind):
        make_env(ARM.format(actuators=element + SERVO), (XML[1],), engine="warp")


def test_config_actuators_ignore_xml_defaults(make_world):
    extra = '<default><pid input="pos vel"/></default>'
    world = make_world(KNEE, extra=extra)
    assert world.sim.mj_model.nu == 1


def test_variants_differ_in_the_ranges_and_gears_of_their_own_actuators():
    arm = ARM.replace('<geom size=".05" mass="1"/>', '<freejoint/><geom size=".05" mass="1"/>', 1)

    def make(reach: float, gear: float) -> mujoco.MjSpec:
        servo = SERVO.replace("-3 3", f"-{reach} {reach}").replace("/>", f' gear="{gear}"/>')
        return mujoco.MjSpec.from_string(arm.format(actuators=TURN + PID + servo))

    variants = {"short": lambda: make(1.0, 2.0), "long": lambda: make(2.0, 5.0)}
    scene = Scene(
        SceneCfg(num_envs=2, entities={"arm": VariantEntityCfg(variants=variants)}), "cpu"
    )
    sim = Simulation(
        2, SimulationCfg(), spec=scene.spec, device="cpu", variant_info=scene.collect_variant_info()
    )
    ankle = sim.mj_model.actuator("arm/ankle").id
    control, force = sim.mj_model.actuator_ctrladr[ankle], sim.mj_model.actuator_outadr[ankle]
    assert sim.model.actuator_ctrlrange[:, control].tolist() == [[-1.0, 1.0], [-2.0, 2.0]]
    assert sim.model.actuator_gear[:, force, 0].tolist() == [2.0, 5.0]


def test_variants_must_have_the_same_controls():
    arm = ARM.replace('<geom size=".05" mass="1"/>', '<freejoint/><geom size=".05" mass="1"/>', 1)
    variants = {
        inputs: lambda inputs=inputs: mujoco.MjSpec.from_string(
            arm.format(actuators=f'<pid name="hip" joint="hip" kp="9" kv="1" input="{inputs}"/>')
        )
        for inputs in ("pos", "pos vel")
    }
    with pytest.raises(ValueError, match="actuators"):
        VariantEntityCfg(variants=variants).build()
