"""Reference in viewers: ghost, slider, start button and body errors."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from page import Page
from tracking_tasks import task_cfg, unperturbed

from mjlab.asset_zoo.robots import get_go1_robot_cfg
from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.tracking.mdp.commands import ghost_model
from mjlab.tasks.tracking.mdp.motion_panel import MotionPanel
from mjlab.viewer.viser.viewer import ViserPlayViewer


class Board:
    """Debug visualizer that records its calls."""

    def __init__(self, *indices: int):
        self.ghosts, self.frames, self._indices = [], [], indices

    def get_env_indices(self, num_envs):
        return [i for i in self._indices if i < num_envs]

    def add_legend(self, color, meaning):
        pass

    def add_ghost_mesh(self, qpos, model, alpha):
        self.ghosts.append((qpos.copy(), model, alpha))

    def add_frame(self, position, rotation, scale, axis_radius, axis_colors):
        self.frames.append((np.asarray(position), scale, axis_colors))


@pytest.fixture
def env():
    cfg = task_cfg("squat,wave", num_envs=3, edit=unperturbed, sampling_mode="start")
    # Something else in the scene that moves.
    cfg.scene.entities = {**cfg.scene.entities, "dog": get_go1_robot_cfg()}
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    yield env
    env.close()


def command_of(env):
    return env.command_manager.get_term("motion")


def test_the_ghost_is_the_robot_alone_in_one_color(env):
    command, board = command_of(env), Board(1)
    command.drawing.draw(board)
    ((qpos, model, alpha),) = board.ghosts
    assert model.nq == len(qpos) == 36
    assert alpha == 0.5
    root = command.motion.body_pos_w[command.frame_indexes[1], 0] + env.scene.env_origins[1]
    np.testing.assert_allclose(qpos[:3], root.numpy(), atol=1e-6)
    np.testing.assert_allclose(qpos[7:], command.joint_pos[1].numpy(), atol=1e-6)
    is_shown = model.geom_group <= 2
    assert is_shown.any()
    assert (model.geom_contype[is_shown] == 0).all()
    np.testing.assert_allclose(model.geom_rgba[is_shown], [[0.5, 0.7, 0.5, 0.5]] * is_shown.sum())
    assert (model.geom_matid == -1).all()
    # The model of the robot in the scene keeps its looks.
    assert not (env.sim.mj_model.geom_rgba[:, 3] == 0.5).any()


def test_ghosts_of_the_environments_in_view(env):
    command, board = command_of(env), Board(0, 2)
    command.drawing.draw(board)
    at_reference = [qpos for qpos, *_ in board.ghosts]
    command.drawing.offset[1] = 1.0
    board = Board(0, 2)
    command.drawing.draw(board)
    for (qpos, *_), before in zip(board.ghosts, at_reference, strict=True):
        np.testing.assert_allclose(qpos[:3] - before[:3], [0.0, 1.0, 0.0], atol=1e-6)
    nothing = Board()
    command.drawing.draw(nothing)
    assert not nothing.ghosts
    # Interactive changes must not modify the config.
    assert command.cfg.viz.ghost_offset == (0.0, 0.0, 0.0)


def test_a_robot_that_is_only_shapes_that_collide_has_a_ghost_too(env):
    class AllCollide:
        cfg = SimpleNamespace(
            build=lambda: SimpleNamespace(
                compile=lambda: __import__("mujoco").MjModel.from_xml_string(
                    "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
                )
            )
        )

    model = ghost_model(AllCollide(), (1.0, 0.0, 0.0, 0.3))
    assert model.geom_group.tolist() == [0]
    np.testing.assert_allclose(model.geom_rgba[0], [1.0, 0.0, 0.0, 0.3])


def test_frames_of_reference_and_robot_can_be_drawn_instead(env):
    command, board = command_of(env), Board(0)
    command.cfg.viz.mode = "frames"
    command.drawing.draw(board)
    assert len(board.frames) == 28
    assert sorted({scale for _, scale, _ in board.frames}) == [0.08, 0.1, 0.12, 0.15]
    np.testing.assert_allclose(board.frames[0][0], command.body_pos_w[0, 0].numpy(), atol=1e-6)
    np.testing.assert_allclose(
        board.frames[14][0], command.robot_body_pos_w[0, 0].numpy(), atol=1e-6
    )


@pytest.fixture
def panel(env):
    """Page with the panel, the displayed environment, and the viewer actions requested."""
    page, asked, view = Page(), [], [0]
    command_of(env).create_gui(
        "motion", page, lambda: view[0], lambda: asked.append("redraw"),
        lambda name, payload: asked.append((name, payload)),
    )  # fmt: skip
    return SimpleNamespace(page=page.widgets, asked=asked, view=view)


def drawn(env):
    command_of(env)._debug_vis_impl(Board(0))


def test_the_slider_follows_the_reference_while_playing(env, panel):
    for _ in range(3):
        env.step(torch.zeros(3, 29))
    drawn(env)
    assert panel.page["Frame"].value == 4
    assert panel.page["Frame"].disabled
    assert panel.page["Frame"].max == 220
    panel.view[0] = 1
    drawn(env)
    assert panel.page["Motion"].value == "wave"
    assert panel.page["Frame"].max == 260
    # The slider is inactive while the motion plays.
    panel.page["Frame"].set_by_person(77)
    drawn(env)
    assert command_of(env).time_steps.tolist() == [4, 4, 4]


def test_the_slider_moves_the_reference_in_view(env, panel):
    command = command_of(env)
    env.command_manager.on_viewer_pause(True)
    assert not panel.page["Frame"].disabled
    panel.page["Frame"].set_by_person(100)
    assert panel.asked == ["redraw"]
    # Requests are executed when the viewer draws, not within a step.
    assert command.time_steps.tolist() == [1, 1, 1]
    drawn(env)
    assert command.time_steps.tolist() == [100, 1, 1]
    panel.page["Motion"].set_by_person("wave")
    panel.page["Frame"].set_by_person(250)
    drawn(env)
    assert (command.motion_ids[0], command.time_steps[0]) == (1, 250)
    env.command_manager.on_viewer_pause(False)
    assert panel.page["Frame"].disabled


def test_start_here_puts_robots_exactly_there(env, panel):
    command = command_of(env)
    env.command_manager.on_viewer_pause(True)
    panel.page["Frame"].set_by_person(110)
    drawn(env)
    panel.page["All envs"].value = False
    panel.page["Start Here"].set_by_person()
    assert panel.asked[-1] == ("start_here", {"type": "gui_reset", "all_envs": False})
    forgotten = []

    class Policy:
        def reset(self, dones=None):
            forgotten.append(dones.tolist())

    viewer = SimpleNamespace(
        env=env,
        policy=Policy(),
        scene=SimpleNamespace(env_idx=0),
        after_reset=lambda: panel.asked.append("done"),
    )
    ViserPlayViewer._gui_reset(viewer, all_envs=False)
    assert panel.asked[-1] == "done"
    assert forgotten == [[1.0] + [0.0] * (env.num_envs - 1)]
    # The robot is there, and the reference a frame ahead, as after every reset.
    assert (command.time_steps[0], command.motion_ids[0]) == (111, 0)
    there = command.matching_frame
    assert (there.robot_body_pos_w - there.body_pos_w)[0].abs().max() < 1e-4
    torch.testing.assert_close(command.body_pos_relative_w, command.relative_poses()[0])
    # The policy observes this state, not the state of the reset.
    assert torch.equal(env.get_observations()["actor"][:, :58], command.command)
    seen = env.observation_manager.compute(update_history=True)
    torch.testing.assert_close(env.obs_buf["critic"], seen["critic"])
    drawn(env)
    lines = panel.page["table"].content.splitlines()
    assert {line.split("|")[2].strip() for line in lines[2:]} == {"0.000"}
    # The request is cleared after use.
    assert not env.command_manager.apply_gui_reset(torch.tensor([0]))


def test_a_start_at_the_last_frame_stays_within_the_motion(env, panel):
    env.command_manager.on_viewer_pause(True)
    panel.page["Frame"].set_by_person(220)
    panel.page["Start Here"].set_by_person()
    env.command_manager.apply_gui_reset(torch.arange(3))
    assert command_of(env).time_steps.tolist() == [220, 220, 220]


def test_the_panel_goes_on_while_the_ghost_is_switched_off(env, panel):
    for _ in range(2):
        env.step(torch.zeros(3, 29))
    assert panel.page["Frame"].value == 3


def test_the_errors_of_the_bodies_are_listed(env, panel):
    drawn(env)
    lines = panel.page["table"].content.splitlines()
    assert len(lines) == 2 + 14
    assert lines[2].split("|")[1].strip() == "pelvis"
    # Of matching times: the robot stands exactly on its frame.
    assert {line.split("|")[2].strip() for line in lines[2:]} == {"0.000"}
    env.command_manager.on_viewer_pause(True)
    panel.page["Frame"].set_by_person(110)
    drawn(env)
    lines = panel.page["table"].content.splitlines()
    # Halfway down, the pelvis of the reference is far below.
    assert float(lines[2].split("|")[2]) > 0.15


def test_without_a_page_nothing_is_asked_for(env):
    command = command_of(env)
    command.on_viewer_pause(True)
    assert not command.apply_gui_reset(torch.arange(3))


def test_names_of_motions_and_bodies_are_text():
    bodies, turns = torch.zeros(1, 1, 3), torch.tensor([[[1.0, 0.0, 0.0, 0.0]]])
    frame = SimpleNamespace(
        body_names=["<b>|"], robot_body_pos_w=bodies, body_pos_relative_w=bodies, body_pos_w=bodies,
        body_quat_relative_w=turns, robot_body_quat_w=turns,
    )  # fmt: skip
    page, library = Page(), SimpleNamespace(names=["walk", "\udcff"], lengths=[9, 9])
    command: Any = SimpleNamespace(
        motion=library, num_envs=1, motion_ids=[1], time_steps=[2], matching_frame=frame,
        drawing=SimpleNamespace(offset=np.zeros(3)),
    )  # fmt: skip
    panel = MotionPanel("motion", page, command, lambda: 0)
    panel.update()
    # Sent as UTF-8.
    assert page.widgets["Motion"].value.encode()
    row = page.widgets["table"].content.splitlines()[-1]
    assert row.startswith("| &lt;b&gt;&#124; |")
