"""Observation terms."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from mjlab.envs.mdp import observations as obs
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.sensor.builtin_sensor import BuiltinSensor
from mjlab.utils.lab_api.math import quat_apply_inverse


def test_root_quantities_are_in_the_roots_frame(make_world: Any) -> None:
    world = make_world()
    quat = torch.tensor([0.6, 0.0, 0.8, 0.0]).expand(4, 4)
    velocity = torch.arange(24.0).reshape(4, 6)
    world.sim.data.qpos[:, 3:7] = quat
    world.robot.write_root_link_velocity_to_sim(velocity)
    world.sim.forward()
    torch.testing.assert_close(
        obs.base_lin_vel(world), quat_apply_inverse(quat, velocity[:, :3]), atol=1e-4, rtol=1e-4
    )
    torch.testing.assert_close(
        obs.base_ang_vel(world), quat_apply_inverse(quat, velocity[:, 3:]), atol=1e-4, rtol=1e-4
    )
    down = torch.tensor([0.0, 0.0, -1.0]).expand(4, 3)
    torch.testing.assert_close(obs.projected_gravity(world), quat_apply_inverse(quat, down))


def test_joint_positions_are_relative_and_biased_on_request(make_world: Any) -> None:
    world = make_world()
    data = world.robot.data
    world.sim.data.qpos[:, 7:] = torch.tensor([0.1, 0.2, 0.3])
    world.sim.data.qvel[:, 6:] = torch.tensor([1.0, 2.0, 3.0])
    data.default_joint_pos[:] = 0.05
    data.default_joint_vel[:] = 0.5
    data.encoder_bias[:] = torch.tensor([0.01, 0.02, 0.03])
    chosen = SceneEntityCfg("robot", joint_names=("ankle", "hip"), preserve_order=True)
    chosen.resolve(world.scene)
    torch.testing.assert_close(
        obs.joint_pos_rel(world, asset_cfg=chosen)[0], torch.tensor([0.25, 0.05])
    )
    torch.testing.assert_close(
        obs.joint_pos_rel(world, biased=True, asset_cfg=chosen)[0], torch.tensor([0.28, 0.06])
    )
    torch.testing.assert_close(
        obs.joint_vel_rel(world, asset_cfg=chosen)[0], torch.tensor([2.5, 0.5])
    )
    assert obs.joint_pos_rel(world).shape == (4, 3)
    # Observing changes nothing.
    torch.testing.assert_close(world.sim.data.qpos[0, 7:], torch.tensor([0.1, 0.2, 0.3]))


def test_actions_and_commands() -> None:
    action, part, command = torch.rand(2, 3), torch.rand(2, 1), torch.rand(2, 4)
    env: Any = SimpleNamespace(
        action_manager=SimpleNamespace(
            action=action, get_term=lambda name: SimpleNamespace(raw_action=part)
        ),
        command_manager=SimpleNamespace(
            get_command=lambda name: command if name == "twist" else None, active_terms=["twist"]
        ),
    )
    assert obs.last_action(env) is action
    assert obs.last_action(env, "arm") is part
    assert obs.generated_commands(env, "twist") is command
    with pytest.raises(ValueError, match=r"command 'twits'.*\['twist'\]"):
        obs.generated_commands(env, "twits")


def test_builtin_sensors_only() -> None:
    class Up(BuiltinSensor):
        def __init__(self) -> None: ...

        @property
        def data(self) -> torch.Tensor:
            return torch.tensor([[0.0, 0.6, 0.8]])

    env: Any = SimpleNamespace(scene={"up": Up(), "rays": SimpleNamespace()})
    assert obs.builtin_sensor(env, "up").tolist() == Up().data.tolist()
    assert torch.equal(obs.projected_gravity_from_sensor(env, "up"), -Up().data)
    with pytest.raises(TypeError, match="'rays': expected BuiltinSensor, got SimpleNamespace"):
        obs.builtin_sensor(env, "rays")


def test_height_scan_is_frame_by_frame_with_a_value_for_misses() -> None:
    # Two frames at heights 2 and 5, three rays each.
    frame_pos = torch.tensor([[[0.0, 0.0, 2.0], [0.0, 0.0, 5.0]]])
    hits = torch.zeros(1, 6, 3)
    hits[0, :, 2] = torch.tensor([0.0, 0.5, 1.0, 1.0, 9.0, 3.0])
    distances = torch.tensor([[2.0, 1.5, 1.0, 4.0, -1.0, 2.0]])
    sensor = SimpleNamespace(
        data=SimpleNamespace(distances=distances, hit_pos_w=hits, frame_pos_w=frame_pos),
        num_frames=2,
        num_rays_per_frame=3,
        cfg=SimpleNamespace(max_distance=10.0),
    )
    env: Any = SimpleNamespace(scene={"scan": sensor})
    assert obs.height_scan(env, "scan").tolist() == [[2.0, 1.5, 1.0, 4.0, 10.0, 2.0]]
    scan = obs.height_scan(env, "scan", offset=0.5, miss_value=-7.0)
    assert scan.tolist() == [[1.5, 1.0, 0.5, 3.5, -7.0, 1.5]]
