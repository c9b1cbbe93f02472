"""Terminations against values known by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from stand_ins import StandInEnv, contacts

from mjlab.tasks.velocity import mdp

# Contacts that end an episode.


def test_any_strong_contact_in_the_last_substeps_is_illegal():
    force = torch.zeros(3, 2, 4, 3)
    force[0, 1, 3] = torch.tensor([0.0, 6.0, 8.1])
    force[1, 0, 0] = torch.tensor([0.0, 6.0, 8.0])
    env: Any = StandInEnv(3, touch=contacts(force_history=force))
    assert mdp.illegal_contact(env, "touch").tolist() == [True, False, False]
    assert mdp.illegal_contact(env, "touch", force_threshold=9.0).tolist() == [True, True, False]


def test_without_a_history_any_contact_is_illegal():
    env: Any = StandInEnv(touch=contacts(found=torch.tensor([[0.0, 1.0], [0.0, 0.0]])))
    assert mdp.illegal_contact(env, "touch").tolist() == [True, False]


# The edges of the terrain.


def on_terrain(*positions: tuple[float, float], rows: int = 10, cols: int = 7, **cfg: Any) -> Any:
    """Return an environment with robots at these places of a generated terrain."""
    env: Any = StandInEnv(len(positions))
    xy = torch.tensor(positions)
    env.data.root_link_pos_w = torch.cat((xy, torch.zeros(len(xy), 1)), dim=1)
    # The grid differs from the config: a curriculum has one column per sub-terrain.
    generator = SimpleNamespace(**{"size": (8.0, 8.0), "border_width": 20.0, "num_cols": 20, **cfg})
    env.scene.terrain = SimpleNamespace(
        terrain_origins=torch.zeros(rows, cols, 3),
        terrain_generator=SimpleNamespace(cfg=generator),
        cfg=SimpleNamespace(terrain_generator=generator),
        bounds=None,
    )
    env.scene.env_origins = torch.zeros(len(xy), 3)
    env.episode_length_buf = torch.full((len(xy),), 3)
    return env


def test_the_bounds_are_those_of_the_grid_that_was_built():
    places = [(59.6, 47.6), (59.8, 0.0), (-59.8, 0.0), (0.0, 47.8), (0.0, -47.8)]
    env = on_terrain(*places)
    assert mdp.out_of_terrain_bounds(env).tolist() == [False, True, True, True, True]
    # Cells need not be square, and the margin is the caller's.
    grid = {"rows": 2, "cols": 3, "size": (8.0, 2.0), "border_width": 4.0}
    env = on_terrain((9.9, 4.9), (10.1, 0.0), (0.0, 5.1), (0.0, 6.1), **grid)
    assert mdp.out_of_terrain_bounds(env, margin=2.0).tolist() == [False, True, True, True]
    assert mdp.out_of_terrain_bounds(env, margin=1.0).tolist() == [False, False, False, True]


def test_walls_add_no_ground():
    env = on_terrain((3.6, 0.0), (3.8, 0.0), rows=1, cols=1, border_width=-5.0)
    assert mdp.out_of_terrain_bounds(env).tolist() == [False, True]
    assert mdp.out_of_terrain_bounds(env, margin=99.0).tolist() == [True, True]


def test_the_edge_of_the_cell_is_a_share_of_half_its_size_away():
    env = on_terrain((3.7, 0.0), (3.9, 0.0), (0.0, -3.9), (-5.9, 2.1))
    env.scene.env_origins[3] = torch.tensor([-2.0, -1.0, 0.0])
    assert mdp.terrain_edge_reached(env).tolist() == [False, True, True, True]
    assert mdp.terrain_edge_reached(env, threshold_fraction=0.99).tolist()[:3] == [False] * 3
    env.episode_length_buf[:] = torch.tensor([3, 3, 2, 1])
    assert mdp.terrain_edge_reached(env).tolist() == [False, True, False, False]


def test_ground_from_a_file_ends_at_its_bounds():
    env = on_terrain((0.5, 1.5), (6.5, 1.5), (6.9, 1.5), (0.5, 0.1))
    env.scene.terrain.bounds = ((-1.0, 0.0), (7.0, 3.0))
    assert mdp.out_of_terrain_bounds(env).tolist() == [False, False, True, True]
    assert mdp.out_of_terrain_bounds(env, margin=1.0).tolist() == [False, True, True, True]


@pytest.mark.parametrize("term", [mdp.out_of_terrain_bounds, mdp.terrain_edge_reached])
def test_a_plane_has_no_edge(term):
    env = on_terrain((1e6, 1e6))
    env.scene.terrain.terrain_origins = None
    assert term(env).tolist() == [False]
    env.scene.terrain = None
    assert term(env).tolist() == [False]


# Falling.


@pytest.mark.parametrize("z", [-1.0, -1.0000002, 1.0000002])
def test_the_angle_of_slightly_more_than_one_is_no_nan(z):
    env: Any = StandInEnv(1)
    env.data.projected_gravity_b = torch.tensor([[0.0, 0.0, z]])
    # Upright has not fallen at any limit, and upside down has at every limit.
    assert mdp.bad_orientation(env, limit_angle=0.0).tolist() == [z > 0]
    assert mdp.bad_orientation(env, limit_angle=3.1).tolist() == [z > 0]


def test_a_robot_has_fallen_beyond_the_limit_of_its_tilt():
    env: Any = StandInEnv(2)
    tilt = torch.tensor([1.21, 1.23])
    zero = torch.zeros(2)
    env.data.projected_gravity_b = torch.stack((torch.sin(tilt), zero, -torch.cos(tilt)), dim=1)
    assert mdp.bad_orientation(env, limit_angle=math.radians(70.0)).tolist() == [False, True]
