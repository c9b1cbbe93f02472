"""Action terms in actuator space."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mjlab.actuator import (
    BuiltinMotorActuatorCfg,
    BuiltinPositionActuatorCfg,
    IdealPdActuatorCfg,
    TransmissionType,
)
from mjlab.envs.mdp import actions as act
from mjlab.utils.state import capture_state

LEG = IdealPdActuatorCfg(target_names_expr=("hip", "knee", "ankle"), stiffness=10.0, damping=1.0)
JOINTS: Any = {"entity_name": "robot", "actuator_names": (".*",)}
LAWS = settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture
def world(make_world: Any) -> Any:
    return make_world(actuators=(LEG,))


def step(term: Any, values: Any) -> None:
    term.process_actions(torch.as_tensor(values, dtype=torch.float).expand(4, -1))
    term.apply_actions()


def test_efforts_are_scaled_shifted_and_clipped(world: Any) -> None:
    cfg = act.JointEffortActionCfg(
        **JOINTS, scale={"hip": 2.0, "knee": 3.0}, offset={"ankle": 1.0}, clip={"k.*": (-1.0, 2.0)}
    )
    term: Any = cfg.build(world)
    step(term, [1.0, 1.0, 1.0])
    assert world.robot.data.joint_effort_target[0].tolist() == [2.0, 2.0, 2.0]
    assert term.raw_action[0].tolist() == [1.0, 1.0, 1.0]
    assert term.target_names == ["hip", "knee", "ankle"]
    assert term._clip.shape == (4, 3, 2)
    assert term.scale.shape == (4, 3)


@LAWS
@given(
    action=st.lists(st.floats(-10.0, 10.0, width=32), min_size=3, max_size=3),
    scale=st.floats(-3.0, 3.0, width=32),
    offset=st.floats(-3.0, 3.0, width=32),
)
def test_processing_is_scale_then_offset_then_clip(
    world: Any, action: list[float], scale: float, offset: float
) -> None:
    cfg = act.JointVelocityActionCfg(
        **JOINTS, scale=scale, offset=offset, use_default_offset=False, clip={".*": (-2.0, 1.5)}
    )
    step(cfg.build(world), action)
    expected = (torch.tensor(action) * scale + offset).clamp(-2.0, 1.5)
    torch.testing.assert_close(world.robot.data.joint_vel_target[0], expected)


def test_positions_start_from_the_default_and_are_those_of_the_encoders(world: Any) -> None:
    data = world.robot.data
    data.default_joint_pos[:] = torch.tensor([0.1, 0.2, 0.3])
    data.encoder_bias[:] = torch.tensor([0.01, 0.02, 0.03])
    term = act.JointPositionActionCfg(**JOINTS, scale=0.5, offset=9.0).build(world)
    step(term, [1.0, 0.0, 0.0])
    expected = torch.tensor([0.59, 0.18, 0.27]).expand(4, 3)
    torch.testing.assert_close(data.joint_pos_target, expected)
    plain = act.JointPositionActionCfg(**JOINTS, offset=1.0, use_default_offset=False)
    step(plain.build(world), [0.0, 0.0, 0.0])
    torch.testing.assert_close(data.joint_pos_target, 1.0 - data.encoder_bias)


@pytest.mark.parametrize("names", [(".*",), ("hip", "ankle")])
@pytest.mark.parametrize("kind", ["pos", "vel"])
def test_the_offset_follows_the_default(world: Any, names: tuple[str, ...], kind: str) -> None:
    data = world.robot.data
    cfg_class = act.JointPositionActionCfg if kind == "pos" else act.JointVelocityActionCfg
    term = cfg_class(entity_name="robot", actuator_names=names).build(world)
    columns = term.target_ids.tolist()
    default = getattr(data, f"default_joint_{kind}")
    for write in (
        lambda: default[:, :].copy_(torch.tensor([0.4, 0.2, -0.1]).expand(4, 3)),
        lambda: default[torch.tensor([1, 3]), 0].fill_(9.0),
        lambda: default.__setitem__((torch.tensor([1, 3])[:, None], torch.tensor([0, 2])), 0.7),
        lambda: setattr(data, f"default_joint_{kind}", default + 1.0),
    ):
        write()
        expected = getattr(data, f"default_joint_{kind}")[:, columns]
        torch.testing.assert_close(term.offset, expected)
        step(term, [0.0] * len(columns))
        target = getattr(data, f"joint_{kind}_target")[:, columns]
        torch.testing.assert_close(target, expected)
    # Writes by a package, alone and beside the default, are kept.
    term.offset[2] = 5.0
    assert getattr(data, f"default_joint_{kind}")[2, 0] != 5.0
    getattr(data, f"default_joint_{kind}")[0, 0] = term.offset[0, 0] = 3.0
    assert term.offset[0, 0] == 3.0
    assert term.offset[2].tolist() == [5.0] * len(columns)


def test_the_offset_follows_in_inference_mode(world: Any) -> None:
    data = world.robot.data
    term = act.JointPositionActionCfg(**JOINTS).build(world)
    with torch.inference_mode():
        data.default_joint_pos[:] = 0.3
        step(term, [0.0, 0.0, 0.0])
        data.default_joint_pos = torch.full((4, 3), 0.6)
        data.default_joint_pos[0] = 0.5
        step(term, [0.0, 0.0, 0.0])
    expected = torch.tensor([0.5, 0.6, 0.6, 0.6])[:, None].expand(4, 3)
    torch.testing.assert_close(data.joint_pos_target, expected)


def test_a_subclass_sets_the_offset(world: Any) -> None:
    class Own(act.JointPositionAction):
        def __init__(self, cfg: Any, env: Any) -> None:
            super().__init__(cfg, env)
            self._offset = self._offset + 1.0

    term = Own(act.JointPositionActionCfg(**JOINTS), world)
    world.robot.data.default_joint_pos[:] = 0.3
    step(term, [0.0, 0.0, 0.0])
    assert world.robot.data.joint_pos_target[0].tolist() == [1.0, 1.0, 1.0]


def test_relative_positions_follow_the_joint(world: Any) -> None:
    data = world.robot.data
    data.encoder_bias[:] = 0.5
    cfg = act.RelativeJointPositionActionCfg(**JOINTS, scale=0.1, clip={".*": (-0.05, 0.05)})
    term = cfg.build(world)
    step(term, [1.0, -0.2, 0.0])
    torch.testing.assert_close(data.joint_pos_target[0], torch.tensor([0.05, -0.02, 0.0]))
    world.sim.data.qpos[:, 7:] = 1.0
    term.apply_actions()
    torch.testing.assert_close(data.joint_pos_target[0], torch.tensor([1.05, 0.98, 1.0]))
    with pytest.raises(ValueError, match="offset: .*got 0.5"):
        act.RelativeJointPositionActionCfg(**JOINTS, offset=0.5)


def test_relative_positions_of_the_start_of_a_step(world: Any) -> None:
    cfg = act.RelativeJointPositionActionCfg(**JOINTS, scale=0.1, read_every_substep=False)
    term = cfg.build(world)
    assert not term.needs_substep
    for start in (0.0, 1.0):
        world.sim.data.qpos[:, 7:] = start
        step(term, [1.0, -0.2, 0.0])
        # The joint moves within the step.
        world.sim.data.qpos[:, 7:] = start + 0.5
        term.apply_actions()
        target = world.robot.data.joint_pos_target[0]
        torch.testing.assert_close(target, start + torch.tensor([0.1, -0.02, 0.0]))


@pytest.mark.parametrize(
    ("preserve_order", "expected"),
    [(False, ["hip", "knee", "ankle"]), (True, ["ankle", "knee", "hip"])],
)
def test_the_order_of_patterns_is_honoured_on_request(
    world: Any, preserve_order: bool, expected: list[str]
) -> None:
    cfg = act.JointEffortActionCfg(
        entity_name="robot",
        actuator_names=("ankle", "knee", "hip"),
        preserve_order=preserve_order,
        scale={"hip": 10.0},
    )
    term = cfg.build(world)
    assert term.target_names == expected
    step(term, [1.0, 2.0, 3.0])
    hip = 30.0 if preserve_order else 10.0
    ankle = 1.0 if preserve_order else 3.0
    assert world.robot.data.joint_effort_target[0].tolist() == [hip, 2.0, ankle]


def test_only_controlled_columns_are_written(world: Any) -> None:
    data = world.robot.data
    data.joint_effort_target[:] = 9.0
    cfg = act.JointEffortActionCfg(entity_name="robot", actuator_names=("ankle", "hip"))
    step(cfg.build(world), [1.0, 2.0])
    assert data.joint_effort_target[0].tolist() == [1.0, 9.0, 2.0]


def test_reset_zeroes_raw_actions_of_the_given_environments(world: Any) -> None:
    term = act.JointEffortActionCfg(**JOINTS).build(world)
    step(term, [1.0, 2.0, 3.0])
    term.reset(torch.tensor([1, 2]))
    assert term.raw_action[:, 0].tolist() == [1.0, 0.0, 0.0, 1.0]
    assert term._processed_actions[:, 0].tolist() == [1.0] * 4
    term.reset()
    assert not term.raw_action.any()


def test_the_caller_may_reuse_its_action_tensor(world: Any) -> None:
    term = act.JointEffortActionCfg(**JOINTS).build(world)
    action = torch.ones(4, 3)
    term.process_actions(action)
    action.zero_()
    assert bool((term.raw_action == 1.0).all())


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("scale", (1.0, 2.0), "scale: .*dict.*tuple"),
        ("offset", "1", "offset: .*dict.*'1'"),
        ("scale", {"elbow": 1.0}, "elbow"),
        ("clip", (0.0, 1.0), "clip: .*dict.*tuple"),
        ("actuator_names", ("elbow",), "elbow"),
    ],
)
def test_bad_configs_are_refused(world: Any, field: str, value: Any, message: str) -> None:
    cfg = act.JointEffortActionCfg(**{**JOINTS, field: value})
    with pytest.raises((TypeError, ValueError), match=message):
        cfg.build(world)


@pytest.mark.parametrize(("pair", "value"), [((1.0, -1.0), -1.0), (0.1, 0.1)])
def test_an_odd_clip_is_a_constant(world: Any, pair: Any, value: float) -> None:
    with pytest.warns(UserWarning, match="clip of target 'hip'"):
        term = act.JointEffortActionCfg(**JOINTS, clip={"hip": pair}).build(world)
    step(term, [5.0, 5.0, 5.0])
    target = world.robot.data.joint_effort_target[0]
    torch.testing.assert_close(target, torch.tensor([value, 5.0, 5.0]))


def test_saved_state_leaves_the_config_to_the_resumed_run(world: Any) -> None:
    term = act.JointPositionActionCfg(**JOINTS, scale={"hip": 2.0}).build(world)
    assert set(capture_state(term)) == {"_raw_actions", "_processed_actions"}


def test_terms_with_constant_targets_need_no_substeps(world: Any) -> None:
    constant = (
        act.JointPositionActionCfg,
        act.JointVelocityActionCfg,
        act.JointEffortActionCfg,
    )
    assert not any(cfg(**JOINTS).build(world).needs_substep for cfg in constant)
    assert act.RelativeJointPositionActionCfg(**JOINTS).build(world).needs_substep

    class Noisy(act.JointEffortAction):
        def apply_actions(self) -> None: ...

    assert Noisy(act.JointEffortActionCfg(**JOINTS), world).needs_substep


def test_tendon_terms(make_cart: Any) -> None:
    tendon = BuiltinPositionActuatorCfg(
        target_names_expr=("rope",),
        transmission_type=TransmissionType.TENDON,
        stiffness=1.0,
        damping=1.0,
    )
    world = make_cart(actuators=(tendon,))
    chosen: Any = {"entity_name": "robot", "actuator_names": ("rope",), "scale": 2.0}
    targets = ("tendon_len_target", "tendon_vel_target", "tendon_effort_target")
    for name, target in zip(("Length", "Velocity", "Effort"), targets, strict=True):
        term = getattr(act, f"Tendon{name}ActionCfg")(**chosen).build(world)
        step(term, [0.5])
        assert bool((getattr(world.robot.data, target) == 1.0).all())
        assert not term.needs_substep


def test_site_terms(make_cart: Any) -> None:
    site = BuiltinMotorActuatorCfg(
        target_names_expr=("tip",), transmission_type=TransmissionType.SITE, effort_limit=10.0
    )
    world = make_cart(actuators=(site,))
    term = act.SiteEffortActionCfg(entity_name="robot", actuator_names=("tip",)).build(world)
    step(term, [0.5])
    assert bool((world.robot.data.site_effort_target == 0.5).all())
    assert not term.needs_substep
