"""Network actuators: what the network sees, and what becomes of its output."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from mjlab.actuator import LearnedMlpActuator, LearnedMlpActuatorCfg, TransmissionType
from mjlab.utils.state import capture_state, restore_state

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.script.*:DeprecationWarning")
JOINTS = ("hip", "knee", "ankle")


class Weighted(torch.nn.Module):
    """Sum of the inputs, each with a weight that tells it apart: 1, 10, 100, ..."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        weights = 10.0 ** torch.arange(x.shape[1], dtype=x.dtype, device=x.device)
        return (x * weights).sum(dim=1, keepdim=True)


class TwoOutputs(torch.nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x[:, :2]


def save(module: torch.nn.Module, folder: Path) -> str:
    path = folder / "network.pt"
    torch.jit.script(module).save(str(path))
    return str(path)


def make_cfg(network: str, **fields) -> LearnedMlpActuatorCfg:
    values = {
        "target_names_expr": JOINTS, "network_file": network, "pos_scale": 1.0, "vel_scale": 1.0,
        "torque_scale": 1.0, "effort_limit": 1e9, "saturation_effort": 1e9, "velocity_limit": 1e9,
        "history_length": 2, **fields,
    }  # fmt: skip
    return LearnedMlpActuatorCfg(**values)


def drive(world, position_target, pos, vel):
    """One substep of commands and feedback; returns the controls (N, 3)."""
    world.sim.data.qpos[:] = pos
    world.sim.data.qvel[:] = vel
    world.entity.set_joint_position_target(torch.full((3, 3), position_target))
    world.entity.write_data_to_sim()
    return world.ctrl.clone()


@pytest.mark.parametrize(
    ("order", "weights"),
    [("pos_vel", (1.0, 10.0, 100.0, 1000.0)), ("vel_pos", (100.0, 1000.0, 1.0, 10.0))],
)
def test_network_sees_errors_and_velocities_newest_first(make_world, tmp_path, order, weights):
    cfg = make_cfg(
        save(Weighted(), tmp_path), input_order=order, pos_scale=2.0, vel_scale=3.0,
        torque_scale=0.5,
    )  # fmt: skip
    world = make_world(cfg)
    drive(world, 1.0, pos=0.5, vel=0.25)
    ctrl = drive(world, 2.0, pos=0.75, vel=0.125)
    inputs = (2.0 * 1.25, 2.0 * 0.5, 3.0 * 0.125, 3.0 * 0.25)
    expected = 0.5 * sum(w * x for w, x in zip(weights, inputs, strict=True))
    torch.testing.assert_close(ctrl, torch.full((3, 3), expected))


def test_resets_fill_histories_of_their_envs(make_world, tmp_path):
    world = make_world(make_cfg(save(Weighted(), tmp_path)))
    first = drive(world, 1.0, pos=0.0, vel=0.0)
    torch.testing.assert_close(first, torch.full((3, 3), 1.0 + 10.0))
    world.entity.actuators[0].reset(torch.tensor([1]))
    second = drive(world, 2.0, pos=0.0, vel=0.0)
    torch.testing.assert_close(second[:, 0], torch.tensor([2.0 + 10.0, 2.0 + 20.0, 2.0 + 10.0]))


def test_writing_for_reset_environments_leaves_other_histories_alone(make_world, tmp_path):
    world = make_world(make_cfg(save(Weighted(), tmp_path)))
    drive(world, 1.0, pos=0.0, vel=0.0)
    reset = torch.tensor([2])
    world.entity.reset(reset)
    world.entity.set_joint_position_target(torch.full((3, 3), 5.0))
    world.entity.write_data_to_sim(reset)
    torch.testing.assert_close(world.ctrl[:, 0], torch.tensor([11.0, 11.0, 55.0]))
    after = drive(world, 7.0, pos=0.0, vel=0.0)
    torch.testing.assert_close(after[:, 0], torch.tensor([17.0, 17.0, 57.0]))


def test_output_is_clipped_to_the_torque_speed_curve(make_world, tmp_path):
    cfg = make_cfg(
        save(Weighted(), tmp_path), effort_limit=8.0, saturation_effort=10.0, velocity_limit=20.0
    )
    ctrl = drive(make_world(cfg), 1000.0, pos=0.0, vel=12.0)
    torch.testing.assert_close(ctrl, torch.full((3, 3), 4.0))


def test_tendons_can_be_driven_too(make_world, tmp_path):
    cfg = make_cfg(
        save(Weighted(), tmp_path), target_names_expr=("cord",),
        transmission_type=TransmissionType.TENDON,
    )  # fmt: skip
    world = make_world(cfg)
    world.entity.set_tendon_len_target(torch.full((3, 1), 0.5))
    world.entity.write_data_to_sim()
    torch.testing.assert_close(world.ctrl, torch.full((3, 1), 5.5))


def test_history_survives_capture_and_restore(make_world, tmp_path):
    world = make_world(make_cfg(save(Weighted(), tmp_path)))
    actuator = world.entity.actuators[0]
    drive(world, 1.0, pos=0.0, vel=0.0)
    state = capture_state(actuator)
    expected = drive(world, 3.0, pos=0.0, vel=0.0)
    drive(world, 9.0, pos=0.0, vel=0.0)
    restore_state(actuator, state)
    torch.testing.assert_close(drive(world, 3.0, pos=0.0, vel=0.0), expected)


def test_missing_network_file_is_reported_when_the_entity_is_built(make_world, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"network_file .*absent\.pt"):
        make_world(make_cfg(str(tmp_path / "absent.pt")))


def test_file_that_is_no_torchscript_is_refused(make_world, tmp_path):
    path = tmp_path / "junk.pt"
    path.write_bytes(b"no network at all")
    with pytest.raises(ValueError, match=r"TorchScript file, got .*junk\.pt"):
        make_world(make_cfg(str(path)))


def test_network_of_another_input_size_is_refused_at_build(make_world, tmp_path):
    with pytest.raises(ValueError, match=r"\(9, 4\).*history_length=2"):
        make_world(make_cfg(save(torch.nn.Linear(6, 1), tmp_path)))


class Flat(torch.nn.Module):
    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        return inputs.sum(dim=-1)


def test_network_may_return_one_value_per_row(make_world, tmp_path):
    world = make_world(make_cfg(save(Flat(), tmp_path)))
    network = world.entity.actuators[0].network
    assert isinstance(network, torch.jit.ScriptModule)
    # Histories of two equal substeps: 2 (e + l') per joint.
    torch.testing.assert_close(drive(world, 1.0, pos=0.25, vel=0.5), torch.full((3, 3), 2.5))


def test_network_of_another_output_size_is_refused_at_build(make_world, tmp_path):
    with pytest.raises(ValueError, match=r"\(9, 1\), got outputs \(9, 2\)"):
        make_world(make_cfg(save(TwoOutputs(), tmp_path)))


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"input_order": "pos"}, "input_order: .*'vel_pos'.*'pos'"),
        ({"history_length": 0}, "history_length: .*0"),
    ],
)
def test_bad_figures_are_refused(fields, named):
    with pytest.raises(ValueError, match=named):
        make_cfg("x.pt", **fields)


def test_it_acts_at_every_substep(make_world, tmp_path):
    actuator = make_world(make_cfg(save(Weighted(), tmp_path))).entity.actuators[0]
    assert isinstance(actuator, LearnedMlpActuator)
    assert actuator.needs_substep
