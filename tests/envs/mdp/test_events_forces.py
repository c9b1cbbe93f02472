"""Forces and torques of events act along the world's axes, on bodies however they are turned.

Three frames can be mistaken for one another: the world's, that of a body's link, and that of its
principal axes of inertia. Here all three differ, and what is checked is the acceleration.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.envs.mdp import events
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.utils.lab_api.math import matrix_from_quat, quat_apply

MASS, MOMENTS = 2.0, (0.05, 0.04, 0.02)
BODY = f"""
<mujoco>
  <worldbody>
    <body name="brick" gravcomp="1">
      <freejoint/>
      <inertial pos=".1 .2 .3" quat=".8 .3 -.4 .2" mass="{MASS}"
                diaginertia="{MOMENTS[0]} {MOMENTS[1]} {MOMENTS[2]}"/>
      <geom size=".1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""
BRICK: dict[str, Any] = {"body_names": ("brick",)}
NUM_ENVS = 6
LINK = torch.tensor([[0.6, 0.0, 0.0, 0.8], [0.6, 0.0, 0.8, 0.0], [0.5, 0.5, 0.5, 0.5]] * 2)
# A force of 5 N for one substep of 5 ms moves the brick by micrometres: the state stays the same.
TIGHT = {"atol": 1e-4, "rtol": 1e-3}


@pytest.fixture(scope="module", params=["native", "warp"])
def brick(world_factory: Callable[..., Any], request: pytest.FixtureRequest) -> Any:
    world = world_factory(BODY, num_envs=NUM_ENVS, engine=request.param)
    _ = world.sim.data.qacc, world.robot.data.body_com_quat_w, world.robot.data.body_com_pos_w
    return world


def at_rest(world: Any, link: torch.Tensor) -> None:
    world.sim.reset()
    world.sim.data.qpos[:, 3:7] = link
    world.sim.forward()


def accelerations(world: Any, link: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return those of the center of mass and of the rotation, at rest, in world axes."""
    world.sim.forward()
    qacc = world.sim.data.qacc
    rotation = quat_apply(link, qacc[:, 3:])
    # The angular part of a free joint is in the link's frame, the linear part at its origin.
    arm = world.robot.data.body_com_pos_w[:, 0] - world.sim.data.qpos[:, :3]
    return qacc[:, :3] + torch.linalg.cross(rotation, arm), rotation


def torque_of(world: Any, rotation: torch.Tensor) -> torch.Tensor:
    axes = matrix_from_quat(world.robot.data.body_com_quat_w[:, 0])
    inertia = axes @ torch.diag(torch.tensor(MOMENTS)) @ axes.transpose(1, 2)
    return (inertia @ rotation[..., None])[..., 0]


def test_an_external_force_and_torque_act_along_the_worlds_axes(brick: Any) -> None:
    at_rest(brick, LINK)
    chosen = SceneEntityCfg("robot", **BRICK)
    chosen.resolve(brick.scene)
    torch.manual_seed(1)
    events.apply_external_force_torque(brick, None, (-5.0, 5.0), (-0.5, 0.5), chosen)
    force, torque = brick.robot.data.body_external_wrench[:, 0].split(3, dim=-1)
    assert len(force.unique()) == 3 * NUM_ENVS
    linear, rotation = accelerations(brick, LINK)
    torch.testing.assert_close(MASS * linear, force, **TIGHT)
    torch.testing.assert_close(torque_of(brick, rotation), torque, **TIGHT)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(seed=st.integers(0, 999), offset=st.tuples(*[st.floats(-0.5, 0.5)] * 3))
def test_an_impulse_acts_at_its_point_of_the_link_along_the_worlds_axes(
    brick: Any, seed: int, offset: tuple[float, float, float]
) -> None:
    generator = torch.Generator().manual_seed(seed)
    link = torch.nn.functional.normalize(torch.randn(NUM_ENVS, 4, generator=generator), dim=1)
    at_rest(brick, link)
    torch.manual_seed(seed)
    params = {
        "force_range": (-5.0, 5.0),
        "torque_range": (0.0, 0.0),
        "duration_s": (1.0, 1.0),
        "cooldown_s": (0.0, 0.0),
        "asset_cfg": SceneEntityCfg("robot", **BRICK),
        "body_point_offset": offset,
    }
    manager = brick.events(
        impulse=EventTermCfg(func=events.apply_body_impulse, mode="step", params=params)
    )
    manager.apply("step", dt=brick.step_dt)
    force = brick.robot.data.body_external_force[:, 0]
    linear, rotation = accelerations(brick, link)
    torch.testing.assert_close(MASS * linear, force, **TIGHT)
    point = quat_apply(link, torch.tensor(offset).expand(NUM_ENVS, 3))
    torch.testing.assert_close(
        torque_of(brick, rotation), torch.linalg.cross(point, force), **TIGHT
    )


def test_a_push_turns_a_turned_body_about_the_worlds_axes(brick: Any) -> None:
    at_rest(brick, LINK)
    push = {"x": (0.5, 0.5), "pitch": (0.25, 0.25)}
    events.push_by_setting_velocity(brick, None, push)
    spin = quat_apply(LINK, brick.sim.data.qvel[:, 3:6])
    torch.testing.assert_close(spin, torch.tensor([0.0, 0.25, 0.0]).expand(NUM_ENVS, 3))
    brick.sim.step()
    # It really turns that way: the link's axes move as omega x axis.
    before = matrix_from_quat(LINK)
    after = matrix_from_quat(brick.sim.data.qpos[:, 3:7])
    turned = torch.linalg.cross(
        torch.tensor([0.0, 0.25, 0.0]).expand(NUM_ENVS, 3, 3), before.transpose(1, 2), dim=-1
    ).transpose(1, 2)
    torch.testing.assert_close((after - before) / 0.005, turned, atol=0.02, rtol=0)
