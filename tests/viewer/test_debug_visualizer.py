"""Debug visualizers of MuJoCo scenes and of the browser."""

from __future__ import annotations

import logging

import mujoco
import numpy as np
import pytest
import viser.transforms as vtf
from hypothesis import given, settings
from hypothesis import strategies as st
from viewer_fakes import FakeEnv

from mjlab.viewer.debug_visualizer import DebugVisualizer, NullDebugVisualizer
from mjlab.viewer.native import MujocoNativeDebugVisualizer
from mjlab.viewer.viser.visualizer import ViserDebugVisualizer, rotations_of_z

MODEL = FakeEnv(1).sim.mj_model
RED, BLUE = (1.0, 0.0, 0.0, 0.25), (0.0, 0.0, 1.0, 0.75)


def native(maxgeom: int = 100) -> MujocoNativeDebugVisualizer:
    return MujocoNativeDebugVisualizer(mujoco.MjvScene(MODEL, maxgeom=maxgeom), MODEL)


def draw_everything(board) -> None:
    board.add_arrow(np.zeros(3), np.array([0.0, 0.0, 1.0]), RED)
    board.add_sphere(np.ones(3), 0.1, BLUE)
    board.add_cylinder(np.zeros(3), np.ones(3), 0.05, RED)
    board.add_ellipsoid(np.zeros(3), np.array([0.1, 0.2, 0.3]), np.eye(3), BLUE)
    board.add_box(np.zeros(3), np.array([0.1, 0.2, 0.3]), np.eye(3), RED)
    board.add_frame(np.zeros(3), np.eye(3), scale=0.5, alpha=0.5)


@pytest.mark.parametrize("board", [NullDebugVisualizer(1), native()])
def test_environments_to_draw_for(board) -> None:
    board.env_idx = 1
    assert list(board.get_env_indices(4)) == [1]
    assert list(board.get_env_indices(1)) == []


def test_all_environments_are_drawn_for_where_asked() -> None:
    board = native()
    board.show_all_envs = True
    assert list(board.get_env_indices(3)) == [0, 1, 2]


def test_the_null_board_takes_every_call() -> None:
    board = NullDebugVisualizer()
    draw_everything(board)
    board.add_ghost_mesh(MODEL.qpos0, MODEL)
    board.clear()
    assert {name for name in dir(DebugVisualizer) if name.startswith("add_")} <= set(dir(board))


def test_native_items_have_their_own_color_and_opacity() -> None:
    board = native()
    draw_everything(board)
    assert board.scn.ngeom == 8
    np.testing.assert_allclose(board.scn.geoms[0].rgba, RED)
    np.testing.assert_allclose(board.scn.geoms[1].rgba, BLUE)
    board.clear()
    assert board.scn.ngeom == 0


def test_native_arrows_point_from_start_to_end() -> None:
    board = native()
    board.add_arrow(np.array([1.0, 0, 0]), np.array([1.0, 2.0, 0]), RED, width=0.02)
    geom = board.scn.geoms[0]
    np.testing.assert_allclose(geom.pos, [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(geom.mat[:, 2], [0, 1, 0], atol=1e-6)


def test_arrows_without_a_length_are_skipped(viser_server) -> None:
    board, page = native(), ViserDebugVisualizer(viser_server, MODEL)
    for target in (board, page):
        target.add_arrow(np.ones(3), np.ones(3), RED)
    assert board.scn.ngeom == 0
    page.send(np.zeros(3))
    assert not page._debug_handles
    page.add_arrow(np.zeros(3), np.ones(3), RED)
    page.add_arrow(np.ones(3), np.ones(3), BLUE)
    page.send(np.zeros(3))
    assert len(page._debug_handles["shaft"].batched_positions) == 1


def test_browser_arrows_reach_from_start_to_end_whatever_their_direction(viser_server) -> None:
    page = ViserDebugVisualizer(viser_server, MODEL)
    ends = [np.array(end, dtype=float) for end in ((0, 0, 2), (0, 0, -2), (3, 0, 0), (1, -2, 2))]
    start = np.array([1.0, 2.0, 3.0])
    for end in ends:
        page.add_arrow(start, start + end, RED, width=0.1)
    page.send(np.zeros(3))
    head = page._debug_handles["head"]
    for i, end in enumerate(ends):
        axis = vtf.SO3(np.asarray(head.batched_wxyzs[i], dtype=float)).as_matrix()[:, 2]
        tip = head.batched_positions[i] + head.batched_scales[i][2] * axis
        np.testing.assert_allclose(tip, start + end, atol=1e-5)
        np.testing.assert_allclose(head.batched_scales[i][:2], 0.2)


def test_a_full_native_scene_warns_once_and_breaks_nothing(caplog) -> None:
    board = native(maxgeom=2)
    with caplog.at_level(logging.WARNING):
        draw_everything(board)
        board.add_ghost_mesh(MODEL.qpos0, MODEL)
    assert board.scn.ngeom == 2
    assert caplog.text.count("2 geoms") == 1


def test_native_ghosts_have_the_opacity_asked_for_and_stand_where_asked() -> None:
    board = native()
    board.add_ghost_mesh(np.array([0.5, 0.0]), MODEL, alpha=0.2)
    geoms = [board.scn.geoms[i] for i in range(board.scn.ngeom)]
    assert len(geoms) == 2  # Cart and pole; not the floor.
    assert all(geom.rgba[3] == pytest.approx(0.2) for geom in geoms)
    np.testing.assert_allclose(geoms[0].pos, [0.5, 0, 1], atol=1e-6)


def test_browser_items_have_their_own_opacity_arrows_included(viser_server) -> None:
    page = ViserDebugVisualizer(viser_server, MODEL)
    page.add_arrow(np.zeros(3), np.array([0, 0, 1.0]), RED)
    page.add_arrow(np.zeros(3), np.array([0, 1.0, 0]), BLUE)
    page.add_sphere(np.zeros(3), 0.1, RED)
    page.add_sphere(np.zeros(3), 0.1, BLUE)
    page.send(np.zeros(3))
    for key in ("shaft", "head", "sphere"):
        np.testing.assert_allclose(page._debug_handles[key].batched_opacities, [0.25, 0.75])


def test_browser_items_last_one_drawing(
    viser_server,
) -> None:
    page = ViserDebugVisualizer(viser_server, MODEL)
    page.add_sphere(np.array([1.0, 2.0, 3.0]), 0.1, RED)
    page.send(np.array([-1.0, 0.0, 0.0]))
    np.testing.assert_allclose(page._debug_handles["sphere"].batched_positions, [[0, 2, 3]])
    page.clear()
    page.add_box(np.zeros(3), np.ones(3), np.eye(3), BLUE)
    page.send(np.zeros(3))
    assert not page._debug_handles["sphere"].visible
    assert page._debug_handles["box"].visible


def test_browser_ghosts_show_moving_geoms_with_the_opacity_asked_for(viser_server) -> None:
    page = ViserDebugVisualizer(viser_server, MODEL)
    for x in (0.5, -0.5):
        page.add_ghost_mesh(np.array([x, 0.0]), MODEL, alpha=0.3)
    page.send(np.zeros(3))
    handles = list(page._debug_handles.values())
    assert len(handles) == 2
    np.testing.assert_allclose(handles[0].batched_positions, [[0.5, 0, 1], [-0.5, 0, 1]])
    np.testing.assert_allclose(handles[0].batched_opacities, 0.3, rtol=1e-6)


@settings(max_examples=50)
@given(st.tuples(*[st.floats(-5, 5)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3))
def test_the_rotation_of_an_arrow_turns_z_onto_its_direction(vector) -> None:
    axis = np.array(vector) / np.linalg.norm(vector)
    [wxyz] = rotations_of_z(axis[None])
    np.testing.assert_allclose(vtf.SO3(wxyz).as_matrix()[:, 2], axis, atol=1e-6)


def test_straight_down_is_a_direction_too() -> None:
    [wxyz] = rotations_of_z(np.array([[0.0, 0.0, -1.0]]))
    np.testing.assert_allclose(vtf.SO3(wxyz).as_matrix()[:, 2], [0.0, 0.0, -1.0], atol=1e-12)
