"""Ray sensors: frames, alignment, what they see, and when."""

from __future__ import annotations

import copy
import dataclasses
import math
from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.entity import EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.envs.mdp import height_scan, time_out
from mjlab.managers.action_manager import ActionTerm, ActionTermCfg
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.observation_manager import ObservationGroupCfg, ObservationTermCfg
from mjlab.managers.reward_manager import RewardTermCfg
from mjlab.managers.termination_manager import TerminationTermCfg
from mjlab.scene import SceneCfg
from mjlab.sensor import (
    GridPatternCfg,
    ObjRef,
    PinholeCameraPatternCfg,
    RayCastSensor,
    RayCastSensorCfg,
    RingPatternCfg,
    TerrainHeightSensorCfg,
)
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.utils.lab_api.math import matrix_from_quat, quat_from_euler_xyz
from mjlab.utils.state import capture_state, restore_state

from .ray_scenes import BASE, ROBOT, floor, scene_with, sense

ENGINES = ("native", "warp")
ONE_RAY = GridPatternCfg(size=(0.0, 0.0))


def scan(name="scan", **kwargs) -> RayCastSensorCfg:
    return RayCastSensorCfg(name=name, **{"frame": BASE, "include_geom_groups": (0,), **kwargs})


def box(name, pos, size=(0.3, 0.3, 0.1), **kwargs):
    def edit(spec: mujoco.MjSpec) -> None:
        spec.worldbody.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=list(size), pos=list(pos), **kwargs
        )

    return edit


def both(*edits):
    def edit(spec: mujoco.MjSpec) -> None:
        for one in edits:
            one(spec)

    return edit


# Measurements.


@pytest.mark.parametrize("engine", ENGINES)
def test_a_scan_over_a_floor_and_a_step_reads_their_heights(engine):
    step = box("step", (0.65, 0.0, 0.1), (0.3, 5.0, 0.1))
    cfg = scan(pattern=GridPatternCfg(size=(1.0, 0.6), resolution=0.2))
    sim, scene = scene_with(cfg, ground=both(floor, step), num_envs=2, engine=engine)
    sim.data.qpos[1, 2] = 2.0
    sense(sim)
    data = scene["scan"].data
    # Columns at x = -0.5, -0.3, -0.1, 0.1, 0.3, 0.5; the step begins at 0.35.
    on_step = torch.tensor([0, 0, 0, 0, 0, 1]).repeat(4)
    for env, height in enumerate((1.0, 2.0)):
        expected = height - 0.2 * on_step
        torch.testing.assert_close(data.distances[env], expected, atol=1e-5, rtol=0)
        torch.testing.assert_close(data.hit_pos_w[env, :, 2], 0.2 * on_step, atol=1e-5, rtol=0)
    assert (data.normals_w == torch.tensor([0.0, 0.0, 1.0])).all()
    assert data.pos_w.tolist() == [[0, 0, 1], [0, 0, 2]]
    assert data.quat_w.tolist() == [[1, 0, 0, 0]] * 2


@pytest.mark.parametrize("engine", ENGINES)
def test_a_sphere_and_a_slope_have_their_normals(engine):
    ball = "<geom type='sphere' size='.5' pos='0 0 0'/>"
    slope = "<geom type='box' size='1 1 .1' pos='3 0 0' euler='0 30 0'/>"
    xml = f"<mujoco><worldbody>{ball}{slope}</worldbody></mujoco>"
    cfgs = (
        scan("ball", pattern=RingPatternCfg.single_ring(0.3, 4)),
        scan("slope", pattern=ONE_RAY, frame=ObjRef("body", "eye", "probe")),
    )
    probe = "<mujoco><worldbody><body name='eye' pos='3 0 2'><freejoint/><geom size='.01' group='3'/></body></worldbody></mujoco>"
    entities = {"robot": ROBOT, "probe": probe, "world": xml}
    sim, scene = scene_with(*cfgs, ground=lambda s: None, engine=engine, entities=entities)
    sense(sim)
    ball_data, slope_data = scene["ball"].data, scene["slope"].data
    rise = math.sqrt(0.5**2 - 0.3**2)
    torch.testing.assert_close(ball_data.distances[0, 1:], torch.full((4,), 1.0 - rise))
    torch.testing.assert_close(ball_data.normals_w[0, 1], torch.tensor([0.6, 0.0, rise / 0.5]))
    tilted = torch.tensor([math.sin(math.pi / 6), 0.0, math.cos(math.pi / 6)])
    torch.testing.assert_close(slope_data.normals_w[0, 0], tilted, atol=1e-5, rtol=0)
    above = 2.0 - 0.1 / math.cos(math.pi / 6)
    assert slope_data.distances[0, 0].item() == pytest.approx(above, abs=1e-5)


@pytest.mark.parametrize("engine", ENGINES)
def test_rays_beyond_their_reach_are_misses(engine):
    sim, scene = scene_with(
        scan("near", max_distance=0.99), scan("far", max_distance=1.01), engine=engine
    )
    sense(sim)
    near, far = scene["near"].data, scene["far"].data
    assert (near.distances == -1.0).all()
    assert (near.normals_w == 0.0).all()
    assert torch.equal(near.hit_pos_w[..., 2], torch.ones(1, 121))
    torch.testing.assert_close(far.distances, torch.ones(1, 121))


@pytest.mark.parametrize("engine", ENGINES)
def test_only_the_listed_geom_groups_are_seen(engine):
    shelf = box("shelf", (0.0, 0.0, 0.4), group=3)
    cfgs = [
        scan(f"g{groups}", pattern=ONE_RAY, include_geom_groups=groups)
        for groups in ((0,), (3,), (0, 3), (1,))
    ]
    sim, scene = scene_with(*cfgs, ground=both(floor, shelf), engine=engine)
    sense(sim)
    seen = [round(scene[cfg.name].data.distances.item(), 4) for cfg in cfgs]
    assert seen == [1.0, 0.5, 0.5, -1.0]


@pytest.mark.parametrize("engine", ENGINES)
def test_the_body_of_the_frame_is_left_out_but_not_its_children(engine):
    cfgs = [
        scan("with", pattern=ONE_RAY, include_geom_groups=None, exclude_parent_body=False),
        scan("without", pattern=ONE_RAY, include_geom_groups=None),
    ]
    sim, scene = scene_with(*cfgs, engine=engine)
    sense(sim)
    # From inside the shell of the body, and past it to the foot below.
    assert scene["with"].data.distances.item() == pytest.approx(0.2, abs=1e-5)
    assert scene["without"].data.distances.item() == pytest.approx(0.35, abs=1e-5)


def test_a_frame_on_the_world_leaves_out_what_is_attached_to_the_world():
    sites = "<mujoco><worldbody><body name='b' pos='0 0 3'/></worldbody></mujoco>"

    def ground(spec: mujoco.MjSpec) -> None:
        floor(spec)
        spec.worldbody.add_site(name="mast", pos=[0, 0, 2])

    cfgs = [
        scan(str(out), frame=ObjRef("site", "mast"), pattern=ONE_RAY, exclude_parent_body=out)
        for out in (True, False)
    ]
    sim, scene = scene_with(*cfgs, ground=ground, entities={"e": sites})
    sense(sim)
    assert scene["True"].data.distances.item() == -1.0
    assert scene["False"].data.distances.item() == pytest.approx(2.0)


@pytest.mark.parametrize("engine", ENGINES)
def test_frames_keep_their_order(engine):
    frames = (
        ObjRef("site", "right", "robot"),
        ObjRef("geom", "foot", "robot"),
        ObjRef("body", "base", "other"),
        ObjRef("site", "left", "robot"),
        ObjRef("body", "base", "robot"),
    )
    cfg = scan(frame=frames, pattern=RingPatternCfg.single_ring(0.1, 2))
    entities = {"robot": ROBOT, "other": ROBOT}
    sim, scene = scene_with(cfg, engine=engine, entities=entities)
    sim.data.qpos[0, 8:11] = torch.tensor([5.0, 0.0, 3.0])
    sense(sim)
    sensor = scene["scan"]
    assert (sensor.num_frames, sensor.num_rays_per_frame, sensor.num_rays) == (5, 3, 15)
    expected = [[0, -0.5, 1], [0, 0, 0.6], [5, 0, 3], [0, 0.5, 1], [0, 0, 1]]
    data = sensor.data
    torch.testing.assert_close(data.frame_pos_w[0], torch.tensor(expected))
    assert torch.equal(data.pos_w, data.frame_pos_w[:, 0])
    assert torch.equal(data.quat_w, data.frame_quat_w[:, 0])
    heights = torch.tensor(expected)[:, 2].repeat_interleave(3)
    torch.testing.assert_close(data.distances[0], heights)
    offsets = torch.tensor([0.0, 0.1, -0.1]).repeat(5)
    start = torch.tensor(expected)[:, 0].repeat_interleave(3) + offsets
    torch.testing.assert_close(data.hit_pos_w[0, :, 0], start)


def test_a_pinhole_pattern_sees_a_wall_as_its_camera_does():
    # A camera at (0, 0, 1) with axes x right, y up, looking along -z: here along the world's +y.
    eye = "<mujoco><worldbody><body name='eye' pos='0 0 1' euler='90 0 0'/></worldbody></mujoco>"
    wall = box("wall", (0.0, 2.1, 5.0), (10.0, 0.1, 5.0))
    cfg = scan(frame=ObjRef("body", "eye", "eye"), pattern=PinholeCameraPatternCfg(4, 2, fovy=90.0))
    sim, scene = scene_with(cfg, ground=wall, entities={"eye": eye})
    sense(sim)
    hits = scene["scan"].data.hit_pos_w.unflatten(1, (2, 4))[0]
    torch.testing.assert_close(hits[0, :, 0], torch.tensor([-3.0, -1.0, 1.0, 3.0]))
    torch.testing.assert_close(hits[0, :, 2], torch.full((4,), 2.0))
    torch.testing.assert_close(hits[1, :, 2], torch.full((4,), 0.0), atol=1e-5, rtol=0)


# Alignment.

ANGLE = st.floats(-math.pi, math.pi)
TILT = st.floats(-1.2, 1.2)


def pose(sim, roll, pitch, yaw) -> torch.Tensor:
    """Turn the robot; return its rotation matrix."""
    quat = quat_from_euler_xyz(*(torch.tensor([angle]) for angle in (roll, pitch, yaw)))
    sim.data.qpos[:, 3:7] = quat
    return matrix_from_quat(quat)[0]


@pytest.fixture(scope="module")
def aligned():
    pattern = GridPatternCfg(size=(0.8, 0.4), direction=(0.3, -0.2, -1.0))
    cfgs = [scan(a, pattern=pattern, ray_alignment=a) for a in ("base", "yaw", "world")]
    sim, scene = scene_with(*cfgs)
    offsets, directions = pattern.generate_rays(None, "cpu")
    return sim, scene, offsets, directions


def rays_of(sensor) -> tuple[torch.Tensor, torch.Tensor]:
    return sensor._origins[0], sensor._directions[0]


@settings(max_examples=30, deadline=None)
@given(roll=ANGLE, pitch=ANGLE, yaw=ANGLE)
def test_alignment_of_rays(aligned, roll, pitch, yaw):
    sim, scene, offsets, directions = aligned
    rotation = pose(sim, roll, pitch, yaw)
    sense(sim)
    position = torch.tensor([0.0, 0.0, 1.0])
    for name, matrix in (("base", rotation), ("world", torch.eye(3))):
        origins, along = rays_of(scene[name])
        torch.testing.assert_close(origins, position + offsets @ matrix.T, atol=2e-5, rtol=0)
        torch.testing.assert_close(along, directions @ matrix.T, atol=2e-5, rtol=0)


@settings(max_examples=30, deadline=None)
@given(roll=TILT, pitch=TILT, yaw=ANGLE)
def test_yaw_aligned_rays_follow_the_heading_and_not_roll_and_pitch(aligned, roll, pitch, yaw):
    sim, scene, offsets, directions = aligned
    pose(sim, roll, pitch, yaw)
    sense(sim)
    turn = matrix_from_quat(
        quat_from_euler_xyz(torch.zeros(1), torch.zeros(1), torch.tensor([yaw]))
    )[0]
    origins, along = rays_of(scene["yaw"])
    torch.testing.assert_close(
        origins, torch.tensor([0.0, 0.0, 1.0]) + offsets @ turn.T, atol=2e-5, rtol=0
    )
    torch.testing.assert_close(along, directions @ turn.T, atol=2e-5, rtol=0)


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2, math.pi / 2 - 0.09])
@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
def test_a_frame_that_points_up_or_down_takes_its_heading_from_its_y_axis(aligned, pitch, yaw):
    sim, scene, offsets, _ = aligned
    pose(sim, 0.0, pitch, yaw)
    sense(sim)
    turn = matrix_from_quat(
        quat_from_euler_xyz(torch.zeros(1), torch.zeros(1), torch.tensor([yaw]))
    )[0]
    expected = torch.tensor([0.0, 0.0, 1.0]) + offsets @ turn.T
    torch.testing.assert_close(rays_of(scene["yaw"])[0], expected, atol=2e-5, rtol=0)


def test_orientations_are_those_of_frames(aligned):
    sim, scene, *_ = aligned
    rotation = pose(sim, 0.3, 0.4, 0.5)
    sense(sim)
    for name in ("base", "yaw", "world"):
        quat = scene[name].data.frame_quat_w[0, 0]
        torch.testing.assert_close(matrix_from_quat(quat), rotation, atol=1e-5, rtol=0)


# Times of ray casts.


def test_data_is_zero_before_the_first_sense_and_then_that_of_the_last_one():
    sim, scene = scene_with(scan(pattern=ONE_RAY))
    sensor = scene["scan"]
    assert sensor.data.distances.tolist() == [[0.0]]
    assert (sensor.data.hit_pos_w == 0).all()
    assert sensor.data.frame_quat_w.isfinite().all()
    sense(sim)
    assert sensor.data.distances.item() == pytest.approx(1.0)
    sim.data.qpos[0, 2] = 3.0
    sim.forward()
    scene.update(0.01)
    scene.reset()
    # Time has passed and the robot has moved, but nothing has been cast.
    assert sensor.data.distances.item() == pytest.approx(1.0)
    assert sensor.data.pos_w[0, 2].item() == pytest.approx(1.0)
    sim.sense()
    assert sensor.data.distances.item() == pytest.approx(3.0)
    assert sensor.data.pos_w[0, 2].item() == pytest.approx(3.0)


def test_a_ray_sensor_does_not_split_the_physics_step():
    assert not scene_with(scan())[1].needs_substep


class Counting(RayCastSensor):
    """Does something after every substep."""

    def update(self, dt: float) -> None:
        self.updates = getattr(self, "updates", 0) + 1


def test_a_subclass_that_overrides_update_is_updated_at_every_substep():
    assert Counting(scan()).needs_substep


def test_what_was_measured_is_computed_once_until_rays_are_cast_again():
    sim, scene = scene_with(scan(), TerrainHeightSensorCfg(name="height", frame=BASE))
    sense(sim)
    for name in ("scan", "height"):
        before = scene[name].data
        scene.update(0.01)
        scene.reset()
        assert scene[name].data is before
        sense(sim)
        assert scene[name].data is not before


def test_orientations_are_those_when_sensed():
    sim, scene = scene_with(scan())
    tilted = quat_from_euler_xyz(*(torch.tensor([a]) for a in (0.3, -0.2, 0.1)))
    sim.data.qpos[:, 3:7] = tilted
    sense(sim)
    data = scene["scan"].data
    sim.data.qpos[:, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    sense(sim)
    torch.testing.assert_close(data.quat_w, tilted)
    torch.testing.assert_close(data.frame_quat_w[:, 0], tilted)
    assert [f.name for f in dataclasses.fields(copy.deepcopy(data))][-1] == "frame_quat_w"
    with pytest.raises(AttributeError, match="no attribute 'quat'"):
        _ = data.quat


def test_a_sensor_cast_alone_measures_the_same():
    cfgs = [scan(name, include_geom_groups=None, exclude_parent_body=False) for name in "ab"]
    sim, scene = scene_with(*cfgs)
    sense(sim)
    together = scene["a"].data.distances.clone()
    scene["a"].raycast_kernel(sim.raycast)
    scene["a"].postprocess_rays()
    assert torch.equal(scene["a"].data.distances, together)


def test_the_rays_that_the_next_reward_reads_are_in_the_saved_state():
    sim, scene = scene_with(scan(), num_envs=2)
    sim.data.qpos[1, 2] = 2.5
    sense(sim)
    before = scene["scan"].data
    saved = capture_state(scene)
    other_sim, other = scene_with(scan(), num_envs=2)
    sense(other_sim)
    restore_state(other, saved)
    other.invalidate_sensor_caches()
    after = other["scan"].data
    for name in ("distances", "normals_w", "hit_pos_w", "frame_pos_w", "frame_quat_w"):
        assert torch.equal(getattr(before, name), getattr(after, name)), name
    # And what was restored is still what the next sense writes to.
    sense(other_sim)
    assert (other["scan"].data.distances - 1.0).abs().max() < 1e-5


def test_an_environment_that_has_diverged_does_not_disturb_the_others():
    sim, scene = scene_with(scan(ray_alignment="yaw"), num_envs=3)
    sim.data.qpos[1] = torch.nan
    sense(sim)
    torch.testing.assert_close(scene["scan"].data.distances[[0, 2]], torch.ones(2, 121))


# Bad input.


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"frame": ObjRef("body", "bas", "robot")}, "body 'bas'.*mean 'base'"),
        ({"frame": ObjRef("site", "zzz", "robot")}, r"site 'zzz'.*\['left', 'right'\]"),
        ({"frame": ObjRef("body", "base", "dog")}, r"entity 'dog'.*\['robot'\]"),
        (
            {"frame": ObjRef("joint", "knee", "robot")},
            "'knee' type.*'body', 'site', 'geom'.*'joint'",
        ),
        ({"ray_alignment": "gravity"}, "ray_alignment.*'base', 'yaw', 'world'.*'gravity'"),
        ({"frame": ()}, r"frame.*\(\)"),
        ({"include_geom_groups": (0, 6)}, r"include_geom_groups.*\[0, 1, 2, 3, 4, 5\].* 6"),
        ({"pattern": PinholeCameraPatternCfg.from_mujoco_camera("eye")}, "robot/eye"),
    ],
)
def test_impossible_ray_sensors_fail_at_build(kwargs, message):
    with pytest.raises(ValueError, match=message) as error:
        scene_with(scan("my_scan", **kwargs))
    assert "Ray sensor 'my_scan'" in str(error.value)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    "fields",
    [
        {"max_distance": 0.0},
        {"max_distance": -1.0},
        {"pattern": GridPatternCfg(direction=(0.0, 0.0, 0.0))},
        {"pattern": RingPatternCfg((), include_center=False)},
    ],
)
def test_a_scan_that_cannot_hit_misses(fields, engine):
    sim, scene = scene_with(scan(**fields), engine=engine)
    sense(sim)
    distances = scene["scan"].data.distances
    assert (distances == -1.0).all()


@pytest.mark.parametrize("engine", ENGINES)
def test_rays_may_have_no_end(engine):
    sim, scene = scene_with(scan(max_distance=math.inf, include_geom_groups=(0,)), engine=engine)
    sense(sim)
    torch.testing.assert_close(scene["scan"].data.distances, torch.ones(1, 121))


# Looking at it.


class Board:
    """Records what is drawn."""

    meansize = 0.1

    def __init__(self):
        self.items = []
        self.legend = {}

    def get_env_indices(self, num_envs):
        return (1,)

    def add_legend(self, color, meaning):
        self.legend[color] = meaning

    def add_sphere(self, center, radius, color, label=None):
        self.items.append((label, np.round(center, 4).tolist(), round(radius, 4), color))

    def add_arrow(self, start, end, color, width=0.015, label=None):
        span = np.round(np.asarray(end) - np.asarray(start), 4).tolist()
        self.items.append((label, span, round(width, 4), color))


def test_hits_rays_and_normals_are_drawn_for_the_environment_in_view():
    viz = RayCastSensorCfg.VizCfg(
        hit_color=(1, 0, 0, 1), miss_color=(0, 0, 1, 1), hit_sphere_color=(0, 1, 0, 1),
        normal_color=(1, 1, 1, 1), hit_sphere_radius=0.5, normal_length=2.0,
        show_rays=True, show_normals=True,
    )  # fmt: skip
    table = box("table", (0.0, 0.0, 0.5), (0.05, 0.5, 0.1))
    pattern = GridPatternCfg(size=(0.2, 0.0), resolution=0.2)
    cfg = scan(pattern=pattern, debug_vis=True, viz=viz, max_distance=4.0)
    hidden = scan("hidden")
    sim, scene = scene_with(cfg, hidden, ground=table, num_envs=2)
    sim.data.qpos[1, 0] = 0.1
    sense(sim)
    board = Board()
    for name in ("scan", "hidden"):
        scene[name].debug_vis(board)
    assert board.items == [
        ("scan_ray_0", [0, 0, -0.4], 0.01, (1, 0, 0, 1)),
        ("scan_hit_0", [0, 0, 0.6], 0.05, (0, 1, 0, 1)),
        ("scan_normal_0", [0, 0, 0.2], 0.01, (1, 1, 1, 1)),
        ("scan_ray_1", [0, 0, -0.2], 0.01, (0, 0, 1, 1)),
    ]
    assert {item[-1] for item in board.items} == set(board.legend)


# In an environment.


class Idle(ActionTerm):
    action_dim = 1
    raw_action = None

    def process_actions(self, actions):
        pass

    def apply_actions(self):
        pass


@dataclass(kw_only=True)
class IdleCfg(ActionTermCfg):
    def build(self, env):
        return Idle(self, env)


def rise(env, env_ids):
    """Put the robot one metre higher in every episode."""
    env.sim.data.qpos[env_ids, 2] = 1.0 + env.common_step_counter


def height_of_the_last_step(env):
    return env.scene["scan"].data.distances[:, 0]


def make_env(num_envs=2) -> ManagerBasedRlEnv:
    robot = EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_string(ROBOT))
    sensors = (scan(pattern=GridPatternCfg(size=(0.2, 0.1)), max_distance=50.0),)
    scan_term = ObservationTermCfg(func=height_scan, params={"sensor_name": "scan", "offset": 0.5})
    cfg = ManagerBasedRlEnvCfg(
        scene=SceneCfg(
            num_envs=num_envs, entities={"robot": robot}, sensors=sensors, spec_fn=floor
        ),
        observations={"actor": ObservationGroupCfg(terms={"scan": scan_term})},
        actions={"idle": IdleCfg(entity_name="robot")},
        rewards={"seen": RewardTermCfg(func=height_of_the_last_step, weight=1.0)},
        terminations={"end": TerminationTermCfg(func=time_out, time_out=True)},
        events={"rise": EventTermCfg(func=rise, mode="reset")},
        sim=SimulationCfg(mujoco=MujocoCfg(gravity=(0.0, 0.0, 0.0))),
        decimation=2,
        episode_length_s=0.012,
        scale_rewards_by_dt=False,
    )
    return ManagerBasedRlEnv(cfg, device="cpu")


def test_rays_of_rewards_are_a_step_old():
    env = make_env()
    obs, _ = env.reset()
    torch.testing.assert_close(obs["actor"], torch.full((2, 6), 0.5))
    lengths = []
    for step in range(1, 9):
        before = env.sim.data.qpos[:, 2].clone()
        obs, reward, _, truncated, _ = env.step(torch.zeros(2, 1))
        # The reward is the height at the end of the step before.
        torch.testing.assert_close(reward, before)
        now = env.sim.data.qpos[:, 2]
        torch.testing.assert_close(obs["actor"], (now - 0.5)[:, None].expand(2, 6))
        lengths.append(bool(truncated[0]))
        assert (now[0].item() == 1.0 + step) or not truncated[0]
    assert any(lengths)
    env.close()
