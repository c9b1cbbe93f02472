"""Impulses: timing, point of application, drawing, resets."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from mjlab.envs.mdp.events import apply_body_impulse
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.utils.lab_api.math import quat_apply
from mjlab.utils.state import capture_state

PARAMS = {
    "force_range": (2.0, 2.0),
    "torque_range": (0.0, 0.0),
    "duration_s": (0.05, 0.05),
    "cooldown_s": (0.1, 0.1),
}


def make_term(world: Any, **overrides: Any) -> Any:
    params = {**PARAMS, "asset_cfg": SceneEntityCfg("robot", body_names=("torso",)), **overrides}
    manager = world.events(
        impulse=EventTermCfg(func=apply_body_impulse, mode="step", params=params)
    )
    return manager


def run(world: Any, manager: Any, steps: int) -> list[bool]:
    """Return, for each environment step that follows a call, whether the wrench acts in env 0."""
    acting = []
    for _ in range(steps):
        manager.apply("step", dt=world.step_dt)
        acting.append(bool((world.sim.data.xfrc_applied[0, 1, :3] == 2.0).all()))
    return acting


def test_an_impulse_lasts_three_steps_and_a_pause_four(make_world: Any) -> None:
    world = make_world()
    acting = run(world, make_term(world), 32)
    # The first pause ends at the fifth call; then off 4 steps, on 3 steps.
    assert acting[:4] == [False] * 4
    period = [True] * 3 + [False] * 4
    assert acting[4:] == (period * 4)[:28]


def test_a_viz_cfg_is_accepted_and_used(make_world: Any) -> None:
    world = make_world()
    manager = make_term(world, viz_cfg={"scale": 0.5, "rgba": (0.0, 1.0, 0.0, 1.0)})
    run(world, manager, 5)
    arrows: list[Any] = []
    visualizer = SimpleNamespace(
        get_env_indices=lambda count: range(count),
        add_legend=lambda color, meaning: None,
        add_arrow=lambda start, end, color, width: arrows.append((start, end, color)),
    )
    manager.get_term_cfg("impulse").func.debug_vis(visualizer)
    assert len(arrows) == 4
    start, end, color = arrows[0]
    com = world.robot.data.body_com_pos_w[0, 0].numpy()
    assert start.tolist() == pytest.approx(com.tolist())
    assert (end - start).tolist() == pytest.approx([1.0, 1.0, 1.0])
    assert color == (0.0, 1.0, 0.0, 1.0)


def test_drawing_defaults_are_those_of_the_interface(make_world: Any) -> None:
    viz = apply_body_impulse.VizCfg()
    assert (viz.rgba, viz.scale, viz.width, viz.min_force) == (
        (0.9, 0.2, 0.8, 0.9), 0.005, 0.015, 1.0,
    )  # fmt: skip
    assert apply_body_impulse.VizCfg((0.0, 0.0, 1.0, 1.0), 0.1).scale == 0.1
    world = make_world()
    # Forces of 2 N on each axis, and of 0.5 N, below the minimum force to draw.
    for force, count in ((2.0, 4), (0.5, 0)):
        manager = make_term(world, force_range=(force, force))
        run(world, manager, 5)
        arrows: list[Any] = []
        visualizer = SimpleNamespace(
            get_env_indices=range,
            add_legend=lambda color, meaning: None,
            add_arrow=lambda *args, width, drawn=arrows: drawn.append((*args, width)),
        )
        manager.get_term_cfg("impulse").func.debug_vis(visualizer)
        assert len(arrows) == count
        for start, end, color, width in arrows:
            assert (end - start).tolist() == pytest.approx([0.01] * 3)
            assert (color, width) == (viz.rgba, viz.width)


def test_weak_and_inactive_impulses_are_not_drawn(make_world: Any) -> None:
    world = make_world()
    drawn: list[Any] = []
    visualizer = SimpleNamespace(
        get_env_indices=lambda count: range(count),
        add_legend=lambda color, meaning: None,
        add_arrow=lambda *a, **k: drawn.append(a),
    )
    manager = make_term(world, viz_cfg=SimpleNamespace(min_force=100.0))
    manager.get_term_cfg("impulse").func.debug_vis(visualizer)
    run(world, manager, 5)
    manager.get_term_cfg("impulse").func.debug_vis(visualizer)
    assert drawn == []


def test_an_offset_is_in_the_frame_of_the_link(make_world: Any) -> None:
    world = make_world()
    # The torso's principal axes are turned against its link, and the link against the world.
    quat = torch.tensor([0.6, 0.0, 0.0, 0.8])
    world.sim.data.qpos[:, 3:7] = quat
    world.sim.forward()
    assert abs(world.sim.mj_model.body_iquat[1, 0]) < 0.99
    manager = make_term(world, force_range=(1.0, 3.0), body_point_offset=(0.0, 0.5, 0.0))
    for _ in range(5):
        manager.apply("step", dt=world.step_dt)
    force, torque = world.sim.data.xfrc_applied[:, 1].split(3, dim=-1)
    arm = quat_apply(quat.expand(4, 4), torch.tensor([0.0, 0.5, 0.0]).expand(4, 3))
    torch.testing.assert_close(torque, torch.linalg.cross(arm, force))
    assert len(force.unique()) == force.numel()


def test_reset_ends_impulses_of_the_given_environments(make_world: Any) -> None:
    world = make_world()
    manager = make_term(world)
    run(world, manager, 5)
    manager.reset(torch.tensor([1, 2]))
    wrench = world.sim.data.xfrc_applied[:, 1, 0]
    assert wrench.tolist() == [2.0, 0.0, 0.0, 2.0]
    # Those start with a full pause; the others end after their three steps.
    for expected in ([2.0, 0.0, 0.0, 2.0],) * 2 + ([0.0] * 4,) * 2 + ([0.0, 2.0, 2.0, 0.0],):
        manager.apply("step", dt=world.step_dt)
        assert world.sim.data.xfrc_applied[:, 1, 0].tolist() == expected


def test_wrenches_of_others_are_left_alone(make_world: Any) -> None:
    world = make_world()
    manager = make_term(world, cooldown_s=(100.0, 100.0))
    world.sim.data.xfrc_applied[:] = 7.0
    run(world, manager, 3)
    manager.reset(None)
    assert bool((world.sim.data.xfrc_applied == 7.0).all())


def test_timers_are_part_of_the_saved_state(make_world: Any) -> None:
    world = make_world()
    term = make_term(world).get_term_cfg("impulse").func
    assert set(capture_state(term)) == {"_remaining", "_active", "_cooldown"}
