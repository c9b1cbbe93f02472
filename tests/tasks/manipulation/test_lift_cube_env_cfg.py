"""Task configs: content beyond their tables."""

from __future__ import annotations

import colorsys

import mujoco
import pytest
import torch
from lifting_tasks import DEPTH, LIFT, MULTI, RGB, task_cfg

from mjlab.tasks.manipulation.config.yam.env_cfgs import (
    get_cube_spec,
    yam_lift_cube_vision_env_cfg,
    yam_multi_cube_seg_env_cfg,
)
from mjlab.tasks.manipulation.lift_cube_env_cfg import make_lift_cube_env_cfg
from mjlab.tasks.registry import list_profiles, list_tasks, load_env_cfg, load_rl_cfg

TASKS = (LIFT, RGB, DEPTH, MULTI)


def test_all_four_tasks_are_registered_with_a_profile_for_a_few_cores():
    assert set(TASKS) <= set(list_tasks())
    for task in TASKS:
        expected = ["cpu"] if task == LIFT else ["cpu", "student"]
        assert list_profiles(task) == expected
        env, rl = load_env_cfg(task, profile="cpu"), load_rl_cfg(task, profile="cpu")
        assert env.scene.num_envs > 1
        assert rl.evaluation.solved_above["success_rate"] > 0.8
        assert rl.evaluation.success is not None


def test_the_profile_helps_fingers_and_keeps_the_contacts():
    table, eased = load_env_cfg(LIFT), load_env_cfg(LIFT, profile="cpu")
    assert set(eased.rewards) - set(table.rewards) == {"lift_narrow"}
    wide, narrow = eased.rewards["lift"], eased.rewards["lift_narrow"]
    assert narrow.func is wide.func
    changed = {name for name in wide.params if wide.params[name] != narrow.params[name]}
    assert changed == {"reaching_std"}
    assert narrow.params["reaching_std"] < wide.params["reaching_std"]
    assert eased.scene.entities["robot"].collisions == table.scene.entities["robot"].collisions
    assert eased.sim.mujoco == table.sim.mujoco


@pytest.mark.parametrize(
    ("task", "actor", "critic", "image"),
    [
        (LIFT, 29, 29, None),
        (RGB, 26, 29, (3, 32, 32)),
        (DEPTH, 26, 29, (1, 32, 32)),
        (MULTI, 26, 26, (2, 32, 32)),
    ],
)
def test_observations_have_the_sizes_of_the_reference(make_env, task, actor, critic, image):
    env = make_env(task, num_envs=2)
    space = env.single_observation_space.spaces
    assert space["actor"].shape == (actor,)
    assert space["critic"].shape == (critic,)
    assert ("camera" in space) == (image is not None)
    if image is not None:
        assert space["camera"].shape == image
        assert env.observation_manager.active_terms["actor"][-1] == "goal_position"
    # Six joints and a finger; the other finger is tied to it.
    assert env.single_action_space.shape == (7,)
    assert env.scene["robot"].num_joints == 8


def test_the_actor_does_not_know_where_the_cube_is_except_from_the_image():
    for task in (RGB, DEPTH, MULTI):
        observations = task_cfg(task).observations
        assert {"ee_to_cube", "cube_to_goal"}.isdisjoint(observations["actor"].terms)
        knows = {"ee_to_cube", "cube_to_goal"} <= observations["critic"].terms.keys()
        assert knows == (task != MULTI)


def test_groups_share_no_config():
    cfg = make_lift_cube_env_cfg()
    actor, critic = (cfg.observations[group].terms for group in ("actor", "critic"))
    for name, term in actor.items():
        assert term is not critic[name]
        assert term == critic[name]
    actor["ee_to_cube"].params["asset_cfg"].site_names = ("elsewhere",)
    assert critic["ee_to_cube"].params["asset_cfg"].site_names == ()


def test_a_config_without_a_robot_says_what_is_missing(make_env):
    def edit(cfg):
        bare = make_lift_cube_env_cfg()
        cfg.scene.sensors = bare.scene.sensors

    with pytest.raises(ValueError, match="ee_ground_collision"):
        make_env(edit=edit)


def test_play_is_endless_and_noiseless():
    for task in TASKS:
        cfg = task_cfg(task, play=True)
        assert cfg.episode_length_s == 1e9
        assert cfg.commands["lift_height"].resampling_time_range == (4.0, 4.0)
        assert cfg.curriculum == {}
        assert not cfg.observations["actor"].enable_corruption


# The cubes.


def test_a_cube_is_what_the_behavior_page_says():
    model = get_cube_spec().compile()
    assert [model.body(1).name, model.joint(0).name, model.geom(0).name] == [
        "cube", "cube_joint", "cube_geom",
    ]  # fmt: skip
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    geom = model.geom(0)
    assert geom.type[0] == mujoco.mjtGeom.mjGEOM_BOX
    assert geom.size.tolist() == [0.02] * 3
    assert model.body_mass[1] == pytest.approx(0.05)
    assert geom.rgba == pytest.approx([0.8, 0.2, 0.2, 1.0])
    assert (geom.contype[0], geom.conaffinity[0], geom.condim[0], geom.group[0]) == (1, 1, 3, 0)
    assert geom.friction == pytest.approx([1, 0.005, 0.0001])


def test_cubes_have_the_size_the_mass_and_the_color_that_is_asked_for():
    model = get_cube_spec(cube_size=0.03, mass=0.2, rgba=(0.1, 0.2, 0.3, 0.4)).compile()
    assert model.geom(0).size.tolist() == [0.03] * 3
    assert model.body_mass[1] == pytest.approx(0.2)
    assert model.geom(0).rgba == pytest.approx([0.1, 0.2, 0.3, 0.4])


@pytest.mark.parametrize("count", [1, 4])
def test_several_cubes_have_colors_around_the_circle(count):
    cfg = yam_multi_cube_seg_env_cfg(num_cubes=count)
    names = [f"cube_{index}" for index in range(count)]
    assert [name for name in cfg.scene.entities if name != "robot"] == names
    assert cfg.commands["lift_height"].entity_names == tuple(names)
    assert cfg.sim.nconmax == 55 + 120 * count
    for index, name in enumerate(names):
        geom = cfg.scene.entities[name].spec_fn().compile().geom(0)
        expected = [*colorsys.hsv_to_rgb(index / count, 0.8, 0.9), 1.0]
        assert geom.rgba == pytest.approx(expected, abs=1e-6)


def test_a_kind_of_image_or_a_number_of_cubes_that_there_is_not_is_refused():
    with pytest.raises(ValueError, match="cam_type.*'rgb', 'depth'.*'lidar'"):
        yam_lift_cube_vision_env_cfg("lidar")  # ty: ignore[invalid-argument-type]
    with pytest.raises(ValueError, match="num_cubes.* 0"):
        yam_multi_cube_seg_env_cfg(num_cubes=0)


def test_every_reset_gives_the_cube_a_new_color_where_color_is_seen(make_env):
    env = make_env(RGB, num_envs=3)
    env.reset()
    cube = env.scene["cube"].indexing.geom_ids
    before = env.sim.model.geom_rgba[:, cube].clone()
    env.reset(env_ids=torch.tensor([1]))
    after = env.sim.model.geom_rgba[:, cube]
    assert (before[1, ..., :3] != after[1, ..., :3]).all()
    assert (before[[0, 2]] == after[[0, 2]]).all()
    assert (after[..., 3] == 1.0).all()


def test_every_fingertip_has_a_friction_of_its_own(make_env):
    env = make_env(num_envs=3)
    tips, names = env.scene["robot"].find_geoms("[lr]f_down(6|7|8|9|10|11)_collision")
    assert len(names) == 12
    ids = env.scene["robot"].indexing.geom_ids[tips]
    friction = env.sim.model.geom_friction[:, ids]
    for axis, (low, high) in enumerate(((0.3, 1.5), (1e-4, 2e-2), (1e-5, 5e-3))):
        values = friction[..., axis]
        assert ((values >= low) & (values <= high)).all()
        assert len(values.unique()) == values.numel()
