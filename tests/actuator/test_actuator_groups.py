"""Groups of actuators: shared delay lines."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.actuator import (
    ActuatorCmd,
    BuiltinActuatorGroup,
    BuiltinMotorActuatorCfg,
    BuiltinPdActuatorCfg,
    BuiltinPositionActuator,
    BuiltinPositionActuatorCfg,
    BuiltinVelocityActuatorCfg,
    DcMotorActuatorCfg,
    FusedActuatorGroup,
    IdealPdActuator,
    IdealPdActuatorCfg,
    TransmissionType,
    XmlActuatorCfg,
)

JOINTS = ("hip", "knee", "ankle")
XML_MOTOR = '<actuator><position joint="ankle" kp="3"/></actuator>'
FIELDS = (
    "joint_pos_target", "joint_vel_target", "joint_effort_target", "tendon_len_target",
    "tendon_vel_target", "tendon_effort_target",
)  # fmt: skip


def position(*names: str, **fields: Any) -> BuiltinPositionActuatorCfg:
    values = {"target_names_expr": names, "stiffness": 5.0, "damping": 1.0, **fields}
    return BuiltinPositionActuatorCfg(**values)


def ideal(*names: str, **fields: Any) -> IdealPdActuatorCfg:
    values = {"target_names_expr": names, "stiffness": 5.0, "damping": 1.0, **fields}
    return IdealPdActuatorCfg(**values)


def dc_motor(*names: str, **fields: Any) -> DcMotorActuatorCfg:
    return DcMotorActuatorCfg(
        target_names_expr=names, stiffness=7.0, damping=0.5, effort_limit=3.0,
        saturation_effort=4.0, velocity_limit=9.0, **fields,
    )  # fmt: skip


def native_pd(*names: str, **fields: Any) -> BuiltinPdActuatorCfg:
    return BuiltinPdActuatorCfg(target_names_expr=names, stiffness=7.0, damping=0.5, **fields)


def velocity(*names: str, **fields: Any) -> BuiltinVelocityActuatorCfg:
    return BuiltinVelocityActuatorCfg(target_names_expr=names, damping=2.0, **fields)


def xml(*names: str, **fields: Any) -> XmlActuatorCfg:
    return XmlActuatorCfg(target_names_expr=("ankle",), **fields)


KINDS = (position, ideal, dc_motor, native_pd, velocity)


def write_one_by_one(world: Any, env_ids: Any = None) -> None:
    for actuator in world.entity.actuators:
        actuator.apply_controls(world.entity.data, env_ids)


@settings(deadline=None, max_examples=25, derandomize=True)
@given(data=st.data())
def test_batched_evaluation_equals_one_by_one(make_world, data):
    """For any mix of kinds, delays and order of elements, and whichever environments are reset."""
    cfgs, extra = [], ""
    for name in data.draw(st.permutations(JOINTS)):
        kind = data.draw(st.sampled_from((*KINDS, xml) if name == "ankle" else KINDS))
        extra = XML_MOTOR if kind is xml else extra
        lag = data.draw(st.integers(0, 2))
        cfgs.append(kind(name, delay_min_lag=lag, delay_max_lag=lag))
    cord = ideal("cord", transmission_type=TransmissionType.TENDON, stiffness=2.0)
    sort = data.draw(st.booleans())
    batched, alone = (make_world(*cfgs, cord, sort=sort, extra=extra) for _ in range(2))
    for actuator in alone.entity.actuators:
        # This takes it out of its group.
        actuator.initialize(alone.sim.mj_model, alone.sim.model, alone.sim.data, "cpu")
    for step in range(5):
        generator = torch.Generator().manual_seed(step)
        reset = torch.tensor([data.draw(st.integers(0, 2))]) if step == 2 else None
        for world in (batched, alone):
            generator.manual_seed(step)
            for name in ("qpos", "qvel"):
                field = getattr(world.sim.data, name)
                field.copy_(torch.randn(field.shape, generator=generator))
            world.sim.forward()
            for name in FIELDS:
                field = getattr(world.entity.data, name)
                field.copy_(torch.randn(field.shape, generator=generator))
            if reset is not None:
                for actuator in world.entity.actuators:
                    actuator.reset(reset)
        batched.entity.write_data_to_sim(reset)
        write_one_by_one(alone, reset)
        assert torch.equal(batched.ctrl, alone.ctrl)
    assert (batched.ctrl != 0.0).any()


@pytest.mark.parametrize(
    "env_ids", [slice(1, 3), torch.tensor([False, True, True]), torch.tensor([2, 1])]
)
@pytest.mark.parametrize("names", [JOINTS, ("hip", "ankle")])
def test_only_the_given_environments_are_written(make_world, env_ids, names):
    world = make_world(*(position(name) for name in names))
    world.entity.set_joint_position_target(torch.full((3, 3), 4.0))
    world.entity.write_data_to_sim(env_ids)
    assert world.ctrl.tolist() == [[0.0] * len(names), [4.0] * len(names), [4.0] * len(names)]


# A subclass of a builtin actuator.


class Mirrored(BuiltinPositionActuator):
    def compute(self, cmd: ActuatorCmd) -> torch.Tensor:
        return -cmd.position_target


class Renamed(BuiltinPositionActuator):
    """Changes nothing about the control."""


class MirroredCfg(BuiltinPositionActuatorCfg):
    kind: type = Mirrored

    def build(self, entity: Any, target_ids: list[int], target_names: list[str]) -> Any:
        return self.kind(self, entity, target_ids, target_names)


def test_subclass_of_a_builtin_actuator_acts_by_its_own_compute(make_world):
    cfg = MirroredCfg(target_names_expr=("hip",), stiffness=1.0, damping=0.0)
    world = make_world(cfg, position("knee"))
    world.entity.set_joint_position_target(torch.full((3, 3), 2.0))
    world.entity.write_data_to_sim()
    assert world.ctrl.tolist() == [[-2.0, 2.0]] * 3
    _, others = BuiltinActuatorGroup.process(world.entity.actuators)
    assert [type(actuator) for actuator in others] == [Mirrored]


def test_subclass_that_keeps_compute_stays_in_the_group(make_world):
    cfg = MirroredCfg(target_names_expr=("hip",), stiffness=1.0, damping=0.0)
    cfg.kind = Renamed
    world = make_world(cfg)
    world.entity.set_joint_position_target(torch.full((3, 3), 2.0))
    world.entity.write_data_to_sim()
    assert world.ctrl.tolist() == [[2.0]] * 3
    assert BuiltinActuatorGroup.process(world.entity.actuators)[1] == ()


# Shared delay lines.


def lags(world: Any, writes: int = 12) -> torch.Tensor:
    """Return the lag that each control shows after some writes, (N, nu)."""
    for k in range(writes):
        for name in FIELDS:
            getattr(world.entity.data, name).fill_(float(k))
        world.entity.write_data_to_sim()
    return writes - 1.0 - world.ctrl


DELAY = {"delay_max_lag": 8, "delay_update_period": 1000}


@pytest.mark.parametrize("kind", [position, velocity])
def test_like_actuators_with_like_delays_have_one_lag_in_each_environment(make_world, kind):
    torch.manual_seed(0)
    world = make_world(kind("hip", **DELAY), kind("knee", "ankle", **DELAY), num_envs=20)
    found = lags(world)
    assert (found == found[:, :1]).all()
    assert len(found[:, 0].unique()) > 1


def test_like_ideal_pd_actuators_share_their_lag(make_world):
    torch.manual_seed(0)
    world = make_world(
        ideal("hip", stiffness=1.0, damping=0.0, **DELAY),
        ideal("knee", stiffness=1.0, damping=0.0, **DELAY),
        num_envs=20,
    )
    for k in range(12):
        world.entity.data.joint_pos_target.fill_(float(k))
        world.entity.write_data_to_sim()
    assert (world.ctrl == world.ctrl[:, :1]).all()
    assert len(world.ctrl[:, 0].unique()) > 1


@pytest.mark.parametrize(
    "cfgs",
    [
        (position("hip", **DELAY), position("knee", **{**DELAY, "delay_max_lag": 7})),
        (position("hip", **DELAY), velocity("knee", **DELAY)),
        (native_pd("hip", **DELAY), native_pd("knee", **DELAY)),
    ],
)
def test_unlike_actuators_and_native_pd_have_lags_of_their_own(make_world, cfgs):
    torch.manual_seed(0)
    found = lags(make_world(*cfgs, num_envs=20))
    assert (found[:, 0] != found[:, -1]).any()


# Control laws.


class Soft(IdealPdActuator):
    """Actuator with a custom control law and parameter."""

    param_names = (*IdealPdActuator.param_names, "gain")

    def initialize(self, mj_model: Any, model: Any, data: Any, device: str) -> None:
        super().initialize(mj_model, model, data, device)
        self.gain = torch.full_like(self.stiffness, 3.0)

    @staticmethod
    def control_law(params: dict[str, torch.Tensor], cmd: ActuatorCmd) -> torch.Tensor:
        return params["gain"] * torch.tanh(cmd.position_target - cmd.pos)


class SoftCfg(IdealPdActuatorCfg):
    kind: type = Soft

    def build(self, entity: Any, target_ids: list[int], target_names: list[str]) -> Any:
        return self.kind(self, entity, target_ids, target_names)


def test_subclass_with_its_own_law_and_parameters(make_world):
    cfgs = [
        SoftCfg(target_names_expr=(name,), stiffness=1.0, damping=0.0) for name in ("knee", "hip")
    ]
    world = make_world(*cfgs)
    assert FusedActuatorGroup.process(world.entity.actuators)[1] == ()
    world.entity.actuators[0].gain[1] = 5.0
    world.entity.set_joint_position_target(torch.tensor([[0.5, 1.0, 0.0]] * 3))
    world.entity.write_data_to_sim()
    knee, hip = torch.tanh(torch.tensor([1.0, 0.5]))
    gains = torch.tensor([3.0, 5.0, 3.0])
    torch.testing.assert_close(world.ctrl, torch.stack((gains * knee, 3.0 * hip.expand(3)), 1))


def test_parameters_that_broadcast_are_accepted(make_world):
    class Shared(Soft):
        def initialize(self, mj_model: Any, model: Any, data: Any, device: str) -> None:
            super().initialize(mj_model, model, data, device)
            self.gain = torch.full((1, 1), 2.0)

    cfg = SoftCfg(target_names_expr=("hip",), stiffness=1.0, damping=0.0)
    cfg.kind = Shared
    world = make_world(cfg)
    world.entity.set_joint_position_target(torch.ones(3, 3))
    world.entity.write_data_to_sim()
    torch.testing.assert_close(world.ctrl, 2.0 * torch.tanh(torch.ones(3, 1)))


def test_subclass_with_its_own_compute(make_world):
    class Halved(IdealPdActuator):
        def compute(self, cmd: ActuatorCmd) -> torch.Tensor:
            return 0.5 * super().compute(cmd)

    cfg = SoftCfg(target_names_expr=("hip",), stiffness=4.0, damping=0.0)
    cfg.kind = Halved
    world = make_world(cfg)
    world.entity.set_joint_position_target(torch.ones(3, 3))
    world.entity.write_data_to_sim()
    assert world.ctrl.tolist() == [[2.0]] * 3


def test_parameters_change_in_place(make_world):
    world = make_world(ideal("knee"), ideal("hip", effort_limit=50.0))
    knee, hip = world.entity.actuators
    knee.set_gains(None, kp=torch.tensor([1.0, 2.0, 3.0]))
    hip.force_limit[0] = 0.25
    world.entity.set_joint_position_target(torch.ones(3, 3))
    world.entity.write_data_to_sim()
    assert world.ctrl.tolist() == [[1.0, 0.25], [2.0, 5.0], [3.0, 5.0]]


def test_motor_on_a_site(make_world):
    cfg = BuiltinMotorActuatorCfg(
        target_names_expr=("toe",), transmission_type=TransmissionType.SITE, effort_limit=9.0
    )
    world = make_world(cfg)
    world.entity.set_site_effort_target(torch.full((3, 1), 2.0))
    world.entity.write_data_to_sim()
    assert world.ctrl.tolist() == [[2.0]] * 3


def test_entities_without_actuators_have_empty_groups():
    group, others = BuiltinActuatorGroup.process([])
    group.initialize(3, "cpu")
    group.apply_controls(None)  # type: ignore[arg-type]
    fused, rest = FusedActuatorGroup.process(others)
    fused.initialize(3, "cpu")
    fused.apply_controls(None)  # type: ignore[arg-type]
    assert rest == ()
