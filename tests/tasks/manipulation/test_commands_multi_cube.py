"""Multi-cube commands: target selection, placement without overlap, visualization."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lifting_stand_ins import Object, StandInEnv, cubes, multi_cube_command
from lifting_tasks import MULTI, lifting

from mjlab.entity import VariantEntityCfg
from mjlab.tasks.manipulation.config.yam.env_cfgs import get_cube_spec
from mjlab.tasks.manipulation.mdp import MultiCubeLiftingCommandCfg
from mjlab.tasks.manipulation.mdp.commands import keep_apart
from mjlab.viewer.debug_visualizer import NullDebugVisualizer

PoseRange = MultiCubeLiftingCommandCfg.ObjectPoseRangeCfg
# Of a cube with edges of 4 cm.
DIAGONAL = 0.04 * math.sqrt(3)


def started(env: StandInEnv | None = None, **fields: Any) -> tuple[StandInEnv, Any]:
    """Return a stand-in and a command, both just reset."""
    env, term = multi_cube_command(env, **fields)
    term.reset(None)
    env.sim.forward()
    term.compute(0.0, torch.arange(env.num_envs))
    env.sim.forwarded.clear()
    return env, term


def placed(env: StandInEnv) -> torch.Tensor:
    """Return the placed cube positions relative to the origins, (N, K, 3)."""
    poses = torch.stack([one.pose[:, :3] for one in env.objects.values()], dim=1)
    return poses - env.scene.env_origins.unsqueeze(1)


def test_draws_have_the_documented_order():
    # In the first two environments the drawn places are far enough apart, in the others they are
    # not: then more numbers are drawn, after all of these.
    env, term = multi_cube_command(cubes(count=2, num_envs=30), difficulty="dynamic")
    torch.manual_seed(3)
    term.reset(None)
    torch.manual_seed(3)
    times = 8.0 + 4.0 * torch.rand(30)
    selection = torch.randint(2, (30,))
    goal = torch.rand(30, 3) * torch.tensor([0.2, 0.4, 0.2]) + torch.tensor([0.3, -0.2, 0.2])
    positions, yaws = [], []
    for _ in range(2):
        drawn = torch.rand(30, 3) * torch.tensor([0.15, 0.3, 0.03])
        positions.append(drawn + torch.tensor([0.25, -0.15, 0.02]))
        yaws.append((2.0 * torch.rand(30) - 1.0) * math.pi)
    torch.testing.assert_close(term.time_left, times)
    assert torch.equal(term.target_selection, selection)
    torch.testing.assert_close(term.command, goal + env.scene.env_origins)
    apart = (positions[0] - positions[1])[:, :2].norm(dim=1) >= DIAGONAL
    assert 0 < apart.sum() < 30
    expected = torch.stack(positions, dim=1)
    torch.testing.assert_close(placed(env)[apart], expected[apart], atol=1e-5, rtol=0)
    # The first cube keeps its place everywhere, and all keep height and yaw.
    torch.testing.assert_close(placed(env)[:, 0], expected[:, 0], atol=1e-5, rtol=0)
    torch.testing.assert_close(placed(env)[..., 2], expected[..., 2])
    for one, yaw in zip(env.objects.values(), yaws, strict=True):
        torch.testing.assert_close(one.pose[:, 6], torch.sin(yaw / 2))


def test_no_cube_is_put_into_another():
    env, term = multi_cube_command(cubes(count=4, num_envs=300))
    term.reset(None)
    where = placed(env)[..., :2]
    distances = torch.cdist(where, where) + torch.eye(4)
    # Origins at 1 km cost some digits.
    assert distances.min() > DIAGONAL - 2e-4
    assert (where >= torch.tensor([0.25, -0.15]) - 2e-4).all()
    assert (where <= torch.tensor([0.40, 0.15]) + 2e-4).all()


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    radii=st.lists(st.floats(0.005, 0.05), min_size=2, max_size=4),
    envs=st.integers(1, 20),
)
def test_placements_are_apart_and_untouched_where_they_were(seed, radii, envs):
    torch.manual_seed(seed)
    radius = torch.tensor(radii)
    apart = radius[:, None] + radius[None, :]
    before = torch.rand(envs, len(radii), 3) * torch.tensor([0.6, 0.6, 0.1])
    after = before.clone()
    keep_apart(after, apart, (0.0, 0.6), (0.0, 0.6))
    others = ~torch.eye(len(radii), dtype=torch.bool)

    def clear(positions: torch.Tensor) -> torch.Tensor:
        gaps = torch.cdist(positions[..., :2], positions[..., :2]) - apart
        return (gaps[:, others] >= -1e-6).all(dim=1)

    assert clear(after).all()
    assert torch.equal(after[..., 2], before[..., 2])
    good = clear(before)
    assert torch.equal(after[good], before[good])


def test_cubes_without_room_warn(caplog):
    tight = PoseRange(x=(0.30, 0.31), y=(0.0, 0.01))
    env, term = multi_cube_command(cubes(count=3), object_pose_range=tight)
    assert "object_pose_range is small for the objects" in caplog.text
    term.reset(None)
    assert torch.isfinite(placed(env)).all()


def test_cubes_for_which_there_is_room_are_not_warned_about(caplog):
    multi_cube_command(cubes(count=3))
    assert caplog.text == ""


def knobbed_cube():
    """Return a cube with a second geom away from its origin."""
    spec = get_cube_spec()
    box = mujoco.mjtGeom.mjGEOM_BOX
    spec.body("cube").add_geom(type=box, size=(0.01,) * 3, pos=(0.08, 0.0, 0.0))
    return spec


@pytest.mark.parametrize(
    ("large", "radius"),
    [
        (lambda: get_cube_spec(cube_size=0.05), 0.05 * math.sqrt(3)),
        (knobbed_cube, 0.08 + 0.01 * math.sqrt(3)),
    ],
    ids=["larger", "with another geom"],
)
def test_variants_of_cubes_are_as_far_apart_as_their_own_sizes_ask(make_env, large, radius):
    def edit(cfg):
        for name in ("cube_0", "cube_1"):
            cfg.scene.entities[name] = VariantEntityCfg(
                variants={"small": get_cube_spec, "large": large},
                assignment=lambda count: [index % 2 for index in range(count)],
            )
        del cfg.scene.entities["cube_2"]
        command = cfg.commands["lift_height"]
        command.entity_names = ("cube_0", "cube_1")
        command.object_pose_range = PoseRange(x=(0.2, 0.5), y=(-0.3, 0.3))

    env = make_env(MULTI, num_envs=100, images=False, edit=edit)
    env.reset()
    where = torch.stack([cube.data.root_link_pos_w for cube in lifting(env).objects])[..., :2]
    gaps = (where[0] - where[1]).norm(dim=1)
    small, large = gaps[0::2], gaps[1::2]
    assert large.min() > 2.0 * radius - 1e-3
    # Small cubes are kept no further apart than necessary.
    assert DIAGONAL - 1e-3 < small.min() < 0.1


# Target selection.


def test_every_cube_is_wanted_as_often():
    _, term = started(cubes(count=3, num_envs=3000))
    shares = torch.bincount(term.target_selection, minlength=3) / 3000
    assert (shares - 1 / 3).abs().max() < 0.04


def test_geoms_of_the_wanted_cube_are_padded_to_the_largest_number():
    num_envs = 3
    env = StandInEnv(
        num_envs,
        one=Object(num_envs, [4]),
        two=Object(num_envs, [2, 5, 1]),
        three=Object(num_envs, [0]),
    )
    _, term = started(env, entity_names=("one", "two", "three"))
    term.target_selection[:] = torch.tensor([1, 0, 2])
    assert term.target_geom_ids.tolist() == [[2, 5, 1], [4, -999, -999], [0, -999, -999]]


def test_the_wanted_cube_is_where_it_is_now_not_where_it_was():
    env, term = started()
    term.target_selection[:] = torch.tensor([0, 1, 2, 1])
    for index, one in enumerate(env.objects.values()):
        one.data.root_link_pos_w[:] = float(index)
    assert term.target_object_pos()[:, 0].tolist() == [0.0, 1.0, 2.0, 1.0]
    env.objects["cube_1"].data.root_link_pos_w[:] = 9.0
    assert term.target_object_pos()[:, 0].tolist() == [0.0, 9.0, 2.0, 9.0]


def test_a_new_goal_moves_all_cubes_of_its_envs():
    env, term = started()
    before = placed(env)
    term.time_left[:] = torch.tensor([5.0, 5.0, 0.0, 5.0])
    term.compute(0.02)
    assert env.sim.forwarded == [[2]]
    moved = (placed(env) != before).any(dim=-1)
    assert moved[2].all()
    assert not moved[[0, 1, 3]].any()


def test_metrics_are_of_the_wanted_cube():
    env, term = started()
    assert set(term.metrics) == {"position_error", "at_goal", "goal_success", "episode_success"}
    term.target_selection[:] = torch.tensor([0, 1, 2, 0])
    for one in env.objects.values():
        one.data.root_link_pos_w[:] = 50.0
    env.objects["cube_1"].data.root_link_pos_w.copy_(term.target_pos)
    term.compute(0.02)
    assert term.compute_success().tolist() == [False, True, False, False]
    assert term.episode_success.tolist() == [0.0, 1.0, 0.0, 0.0]


class Board(NullDebugVisualizer):
    def __init__(self) -> None:
        super().__init__(1)
        self.spheres: list[tuple] = []

    def add_sphere(self, center, radius, color, label=None) -> None:
        self.spheres.append((center.tolist(), radius, color))


def test_viewers_show_the_goal_and_mark_the_wanted_cube():
    env, term = started(debug_vis=True)
    term.target_selection[:] = 2
    env.objects["cube_2"].data.root_link_pos_w[1] = torch.tensor([1.0, 2.0, 3.0])
    board = Board()
    term.debug_vis(board)
    (goal, goal_radius, goal_color), (mark, mark_radius, mark_color) = board.spheres
    assert goal == term.target_pos[1].tolist()
    assert (goal_radius, goal_color) == (0.03, (1.0, 0.5, 0.0, 0.3))
    assert mark == pytest.approx([1.0, 2.0, 3.04])
    assert (mark_radius, mark_color) == (0.01, (1.0, 0.0, 0.0, 1.0))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"difficulty": "hard"}, "difficulty"),
    ],
)
def test_a_mistake_in_the_config_is_one_clear_message(fields, message):
    with pytest.raises(ValueError, match=message):
        multi_cube_command(**fields)
