"""Behavior shared by all actuators: config checks, delays, custom kinds, substeps."""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import pytest
import torch

from mjlab.actuator import (
    Actuator,
    ActuatorCfg,
    ActuatorCmd,
    BuiltinDcMotorActuatorCfg,
    BuiltinMotorActuatorCfg,
    BuiltinMuscleActuatorCfg,
    BuiltinPdActuatorCfg,
    BuiltinPositionActuatorCfg,
    BuiltinVelocityActuatorCfg,
    DcMotorActuatorCfg,
    DcMotorDatasheetParams,
    IdealPdActuatorCfg,
    TransmissionType,
    XmlActuatorCfg,
)
from mjlab.actuator.actuator import DirectActuator, delay_command
from mjlab.utils.buffers import DelayBuffer
from mjlab.utils.state import capture_state, restore_state

JOINTS = ("hip", "knee", "ankle")
MOTOR = DcMotorDatasheetParams(nominal_voltage=24.0, stall_torque=5.0, no_load_speed=30.0)


def motor_cfg(**fields: Any) -> BuiltinMotorActuatorCfg:
    return BuiltinMotorActuatorCfg(**{"target_names_expr": JOINTS, "effort_limit": 1e6, **fields})


@dataclass(kw_only=True)
class CustomCfg(ActuatorCfg):
    """A kind that a user wrote: a motor that doubles its command."""

    def build(self, entity: Any, target_ids: list[int], target_names: list[str]) -> Custom:
        return Custom(self, entity, target_ids, target_names)


class Custom(Actuator[CustomCfg]):
    def edit_spec(self, spec: mujoco.MjSpec, target_names: list[str]) -> None:
        for name in target_names:
            element = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            element.set_to_motor()
            self._mjs_actuators.append(element)

    def compute(self, cmd: ActuatorCmd) -> torch.Tensor:
        return 2.0 * cmd.effort_target


# Checks of the config.


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"armature": -0.1}, "armature: .*-0.1"),
        ({"frictionloss": -1.0}, "frictionloss: .*-1.0"),
        ({"viscous_damping": float("nan")}, "viscous_damping: .*nan"),
        ({"delay_min_lag": -1}, "delay_min_lag: .*-1"),
        ({"delay_min_lag": 3, "delay_max_lag": 2}, r"delay_max_lag: .*\[3, inf\], got 2"),
        ({"delay_hold_prob": 1.5}, "delay_hold_prob: .*1.5"),
        ({"delay_update_period": -1}, "delay_update_period: .*-1"),
        ({"transmission_type": "wheel"}, "transmission_type: .*tendon.*'wheel'"),
        ({"effort_limit": -2.0}, "effort_limit: .*-2.0"),
        ({"transmission_type": TransmissionType.SITE, "armature": 0.1}, "armature: .*site.*0.1"),
    ],
)
def test_figures_that_make_no_sense_are_refused_by_name(fields, named):
    with pytest.raises(ValueError, match=f"BuiltinMotorActuatorCfg for .*{named}"):
        motor_cfg(**fields)


def test_a_config_changed_after_it_was_made_is_checked_when_built(make_world):
    cfg = motor_cfg()
    cfg.delay_min_lag = 5
    with pytest.raises(ValueError, match=r"delay_max_lag: .*\[5, inf\], got 0"):
        make_world(cfg)


def test_names_may_be_a_single_string(make_world):
    world = make_world(motor_cfg(target_names_expr="knee"))
    assert world.entity.actuators[0].target_names == ["knee"]


@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        (BuiltinPositionActuatorCfg, {"stiffness": 1.0, "damping": 1.0}),
        (BuiltinVelocityActuatorCfg, {"damping": 1.0}),
        (BuiltinPdActuatorCfg, {"stiffness": 1.0, "damping": 1.0}),
        (BuiltinMuscleActuatorCfg, {}),
        (BuiltinDcMotorActuatorCfg, {"motor_params": MOTOR, "stiffness": 1, "voltage_limit": 1}),
    ],
)
def test_kinds_that_control_a_position_or_velocity_refuse_sites(kind, fields):
    with pytest.raises(ValueError, match="a site has no position or velocity"):
        kind(target_names_expr=("toe",), transmission_type=TransmissionType.SITE, **fields)


def test_zero_armature_on_a_site_is_accepted():
    cfg = motor_cfg(transmission_type=TransmissionType.SITE, armature=0.0)
    assert cfg.armature == 0.0


def test_transmission_may_be_given_by_its_value(make_world):
    world = make_world(motor_cfg(target_names_expr=("cord",), transmission_type="tendon"))
    assert world.entity.actuators[0].transmission_type is TransmissionType.TENDON


def test_pattern_matching_nothing_lists_candidates_and_where_it_does_match(make_world):
    with pytest.raises(ValueError, match=r"(?s)cord.*hip.*knee.*ankle.*tendons \['cord'\]"):
        make_world(motor_cfg(target_names_expr=("cord",)))


# Life of an actuator.


def test_ids_before_initialize_say_when_they_are_known():
    actuator = motor_cfg().build(None, [0], ["hip"])  # type: ignore[arg-type]
    for name in ("target_ids", "ctrl_ids", "global_ctrl_ids"):
        with pytest.raises(RuntimeError, match="after Scene.initialize"):
            getattr(actuator, name)


def test_custom_actuator_without_elements_warns(make_world):
    class Forgetful(Custom):
        def edit_spec(self, spec: mujoco.MjSpec, target_names: list[str]) -> None:
            super().edit_spec(spec, target_names)
            self._mjs_actuators.clear()

    class ForgetfulCfg(CustomCfg):
        def build(self, entity: Any, target_ids: list[int], target_names: list[str]) -> Custom:
            return Forgetful(self, entity, target_ids, target_names)

    with pytest.warns(UserWarning, match="no MuJoCo actuators") as caught:
        world = make_world(ForgetfulCfg(target_names_expr=JOINTS))
    assert len(caught) == 1
    before = world.ctrl.clone()
    world.entity.set_joint_effort_target(torch.ones(3, 3))
    world.entity.write_data_to_sim()
    assert torch.equal(world.ctrl, before)


def test_custom_kind_that_does_not_say_what_to_add_is_refused(make_world):
    class Silent(DirectActuator):
        command_fields = ("effort",)

    class SilentCfg(ActuatorCfg):
        def build(self, entity: Any, target_ids: list[int], target_names: list[str]) -> Silent:
            return Silent(self, entity, target_ids, target_names)

    with pytest.raises(NotImplementedError, match=r"Silent must define _add_element.*or edit_spec"):
        make_world(SilentCfg(target_names_expr=JOINTS))


def test_custom_kind_acts_by_its_own_compute(make_world):
    world = make_world(CustomCfg(target_names_expr=("knee",)))
    world.entity.set_joint_effort_target(torch.tensor([[1.0, 2.0, 3.0]] * 3))
    world.entity.write_data_to_sim()
    assert world.ctrl.tolist() == [[4.0]] * 3


def test_commands_are_copies_that_may_be_changed(make_world):
    world = make_world(CustomCfg(target_names_expr=JOINTS))
    world.entity.set_joint_effort_target(torch.ones(3, 3))
    cmd = world.entity.actuators[0].get_command(world.entity.data)
    cmd.effort_target.zero_()
    cmd.pos.fill_(9.0)
    assert (world.entity.data.joint_effort_target == 1.0).all()
    assert (world.sim.data.qpos == 0.0).all()


def test_control_law_of_a_kind_without_one_says_so():
    with pytest.raises(NotImplementedError, match="control_law"):
        Custom.control_law({}, None)  # type: ignore[arg-type]


# Substeps.


def test_only_actuators_that_change_between_substeps_need_them(make_world):
    extra = '<actuator><motor joint="ankle"/></actuator>'
    world = make_world(
        BuiltinPdActuatorCfg(target_names_expr=("hip",), stiffness=1.0, damping=1.0),
        motor_cfg(target_names_expr=("knee",)),
        XmlActuatorCfg(target_names_expr=("ankle",)),
        extra=extra,
    )
    assert [actuator.needs_substep for actuator in world.entity.actuators] == [False] * 3


@pytest.mark.parametrize(
    "cfg",
    [
        motor_cfg(delay_max_lag=1),
        IdealPdActuatorCfg(target_names_expr=JOINTS, stiffness=1.0, damping=1.0),
        CustomCfg(target_names_expr=JOINTS),
    ],
)
def test_delay_and_control_laws_in_torch_need_every_substep(make_world, cfg):
    assert make_world(cfg).entity.actuators[0].needs_substep


def test_overriding_update_or_compute_asks_for_every_substep():
    class Ticking(type(motor_cfg().build(None, [0], ["hip"]))):  # type: ignore[misc, arg-type]
        def update(self, dt: float) -> None:
            pass

    class Own(type(motor_cfg().build(None, [0], ["hip"]))):  # type: ignore[misc, arg-type]
        def compute(self, cmd: ActuatorCmd) -> torch.Tensor:
            return cmd.effort_target

    for kind in (Ticking, Own):
        assert kind(motor_cfg(), None, [0], ["hip"]).needs_substep


# Delay.


def write(world: Any, value: float) -> list[float]:
    """One substep that commands `value`; returns the control of each environment."""
    world.entity.set_joint_effort_target(torch.full((3, 3), value))
    world.entity.write_data_to_sim()
    assert (world.ctrl == world.ctrl[:, :1]).all(), "targets of one line are delayed together"
    return world.ctrl[:, 0].tolist()


def test_a_fixed_lag_returns_the_command_of_that_many_writes_ago(make_world):
    world = make_world(motor_cfg(delay_min_lag=2, delay_max_lag=2))
    values = [write(world, float(k))[0] for k in range(1, 7)]
    # The first command fills the line.
    assert values == [1.0, 1.0, 1.0, 2.0, 3.0, 4.0]


NO_LAG = {"delay_min_lag": 0, "delay_max_lag": 0}
FIXED_LAG = {"delay_min_lag": 2, "delay_max_lag": 2}
ALL_JOINTS: dict[str, Any] = {"target_names_expr": ("hip", "knee", "ankle"), **FIXED_LAG}
DELAYED = {
    "position": BuiltinPositionActuatorCfg(**ALL_JOINTS, stiffness=2.0, damping=0.0),
    "velocity": BuiltinVelocityActuatorCfg(**ALL_JOINTS, damping=3.0),
    "motor": BuiltinMotorActuatorCfg(**ALL_JOINTS, effort_limit=1e6),
    "native pd": BuiltinPdActuatorCfg(**ALL_JOINTS, stiffness=2.0, damping=3.0),
    "ideal pd": IdealPdActuatorCfg(**ALL_JOINTS, stiffness=2.0, damping=3.0),
    "dc motor": DcMotorActuatorCfg(
        **ALL_JOINTS, stiffness=2.0, damping=3.0, effort_limit=1e6, saturation_effort=1e6,
        velocity_limit=1e6,
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", DELAYED)
def test_a_delay_holds_back_every_target_and_every_command_of_it(make_world, kind):
    """Each of three joints gets what it alone was told, and every part of it two writes late."""
    now, late = (
        make_world(cfg) for cfg in (replace(DELAYED[kind], **NO_LAG), DELAYED[kind])
    )  # fmt: skip
    forces = {"now": [], "late": []}
    for k in range(7):
        generator = torch.Generator().manual_seed(k)
        commands = torch.randn(3, 3, 3, generator=generator)
        for world, told in ((now, forces["now"]), (late, forces["late"])):
            data = world.entity.data
            data.joint_pos_target[:], data.joint_vel_target[:] = commands[0], commands[1]
            data.joint_effort_target[:] = commands[2]
            world.force()
            told.append(world.sim.data.qfrc_actuator.clone())
    for k in range(2, 7):
        torch.testing.assert_close(forces["late"][k], forces["now"][k - 2])
    assert len(forces["now"][3].unique()) == 9


def test_position_velocity_and_effort_of_a_command_are_of_the_same_age():
    line = DelayBuffer(min_lag=0, max_lag=3, batch_size=50)
    for k in range(1, 30):
        now = torch.full((50, 2), float(k))
        position, velocity, effort = delay_command(line, now, 10.0 * now, 100.0 * now)
        torch.testing.assert_close(velocity, 10.0 * position)
        torch.testing.assert_close(effort, 100.0 * position)


@pytest.mark.parametrize("hold", [0.0, 1.0])
@pytest.mark.parametrize("partial", [False, True])
def test_lag_after_a_reset_is_within_its_range_at_once(make_world, hold, partial):
    """With a long period, or holding, no lag is drawn for long: it must not be 0 until then."""
    world = make_world(
        motor_cfg(delay_min_lag=2, delay_max_lag=4, delay_update_period=1000, delay_hold_prob=hold)
    )
    for k in range(10):
        write(world, float(k))
    if partial:
        env_ids = torch.arange(3)
        world.entity.reset(env_ids)
        world.entity.write_data_to_sim(env_ids)
    else:
        world.entity.reset()
    seen = torch.tensor([write(world, float(k)) for k in range(100, 110)])
    lags = 109.0 - seen[-1]
    assert ((lags >= 2) & (lags <= 4)).all()


def test_set_lags_is_clamped_and_lasts_until_the_next_draw(make_world):
    world = make_world(
        motor_cfg(
            delay_min_lag=1, delay_max_lag=3, delay_update_period=1000, delay_per_env_phase=False,
        )
    )  # fmt: skip
    write(world, 0.0)
    world.entity.actuators[0].set_lags(torch.tensor([0, 2, 9]))
    for k in range(1, 6):
        seen = write(world, float(k))
    assert seen == [4.0, 3.0, 2.0]
    world.entity.actuators[0].set_lags(torch.tensor([3]), torch.tensor([0]))
    assert write(world, 6.0) == [3.0, 4.0, 3.0]


def test_set_lags_without_a_delay_changes_nothing(make_world):
    world = make_world(motor_cfg())
    world.entity.actuators[0].set_lags(torch.tensor([5, 5, 5]))
    assert [write(world, 1.0), write(world, 2.0)] == [[1.0] * 3, [2.0] * 3]


def test_feedback_is_never_delayed(make_world):
    cfg = IdealPdActuatorCfg(
        target_names_expr=JOINTS, stiffness=1.0, damping=0.0, delay_min_lag=2, delay_max_lag=2
    )
    world = make_world(cfg)
    for k in range(4):
        world.sim.data.qpos[:] = float(k)
        assert write(world, 0.0) == [-float(k)] * 3


def test_resetting_one_environment_leaves_the_lines_of_others_alone(make_world):
    world, twin = (make_world(motor_cfg(delay_min_lag=2, delay_max_lag=2)) for _ in range(2))
    for k in (1.0, 2.0, 3.0):
        write(world, k)
        write(twin, k)
    reset = torch.tensor([1])
    world.entity.reset(reset)
    world.entity.data.joint_effort_target[reset] = 50.0
    world.entity.write_data_to_sim(reset)
    assert world.ctrl[:, 0].tolist() == [1.0, 50.0, 1.0]
    for k in (4.0, 5.0, 6.0):
        mine, others = write(world, k), write(twin, k)
        assert [mine[0], mine[2]] == [others[0], others[2]]
        assert mine[1] == {4.0: 50.0, 5.0: 50.0, 6.0: 4.0}[k]


def test_the_first_write_ever_may_be_for_some_environments(make_world):
    world = make_world(motor_cfg(delay_min_lag=1, delay_max_lag=1))
    world.entity.set_joint_effort_target(torch.full((3, 3), 7.0))
    world.entity.write_data_to_sim(torch.tensor([0]))
    assert world.ctrl[:, 0].tolist() == [7.0, 0.0, 0.0]
    assert write(world, 8.0) == [7.0, 8.0, 8.0]


def test_custom_kinds_are_delayed_and_reset_too(make_world):
    world = make_world(CustomCfg(target_names_expr=JOINTS, delay_min_lag=1, delay_max_lag=1))
    assert [write(world, 1.0), write(world, 2.0)] == [[2.0] * 3, [2.0] * 3]
    reset = torch.tensor([2])
    world.entity.reset(reset)
    world.entity.set_joint_effort_target(torch.full((3, 3), 9.0))
    world.entity.write_data_to_sim(reset)
    assert world.ctrl[:, 0].tolist() == [2.0, 2.0, 18.0]
    assert write(world, 3.0) == [4.0, 4.0, 18.0]


def test_delay_line_survives_capture_and_restore(make_world):
    world = make_world(motor_cfg(delay_min_lag=0, delay_max_lag=3, delay_hold_prob=0.5))
    for k in range(5):
        write(world, float(k))
    state = capture_state(world.entity.actuators[0])
    rng = torch.get_rng_state()
    expected = [write(world, float(k)) for k in range(5, 10)]
    torch.set_rng_state(rng)
    restore_state(world.entity.actuators[0], state)
    assert [write(world, float(k)) for k in range(5, 10)] == expected


def test_older_delayed_config_delays_the_config_it_wraps(make_world):
    # Warns once per process, perhaps in an earlier test.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        from mjlab.actuator import DelayedActuator, DelayedActuatorCfg
    from mjlab.actuator.delayed_actuator import DelayedActuatorCfg as SameCfg

    assert SameCfg is DelayedActuatorCfg
    base = motor_cfg()
    cfg = DelayedActuatorCfg(base_cfg=base, delay_target="effort", delay_max_lag=2)
    assert isinstance(cfg, DelayedActuatorCfg)
    assert cfg.base_cfg is base
    assert cfg.target_names_expr == base.target_names_expr
    assert not isinstance(base, DelayedActuatorCfg)
    cfg = dataclasses.replace(cfg, delay_min_lag=2)
    world = make_world(cfg)
    delayed = world.entity.actuators[0]
    assert isinstance(delayed, DelayedActuator)
    assert delayed.base_actuator is delayed
    assert delayed.command_field == "effort"
    assert isinstance(world.entity.actuators[0].cfg, BuiltinMotorActuatorCfg)
    assert not make_world(DelayedActuatorCfg(base_cfg=base)).entity.actuators[0].has_delay
    assert [write(world, float(k))[0] for k in range(1, 5)] == [1.0, 1.0, 1.0, 2.0]
