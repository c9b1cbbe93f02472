"""Observations of hand, object, goal and images."""

from __future__ import annotations

import copy
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from lifting_stand_ins import cubes, multi_cube_command
from lifting_tasks import DEPTH, MULTI, RGB, lifting, move, task_cfg

from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import ObservationTermCfg, SceneEntityCfg
from mjlab.tasks.manipulation import mdp

SITE = "robot/grasp_site"


@pytest.fixture(scope="module")
def env():
    """Arms after some random motion, with rotated bases."""
    cfg = task_cfg(num_envs=3)
    cfg.events["reset_base"].params["pose_range"] = {"yaw": (0.4, 2.0), "pitch": (0.1, 0.2)}
    # Resampling in between is part of it.
    cfg.commands["lift_height"].resampling_time_range = (0.1, 0.2)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    move(env, 20)
    yield env
    env.close()


@pytest.fixture(scope="module")
def hand(env):
    cfg = SceneEntityCfg("robot", site_names=("grasp_site",))
    cfg.resolve(env.scene)
    return cfg


def host(env, index: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return MuJoCo model and data of the state of an environment."""
    model = env.sim.mj_model
    data = mujoco.MjData(model)
    env.sim.copy_to_host(index, data)
    mujoco.mj_forward(model, data)
    return model, data


def rows(env, row) -> torch.Tensor:
    """Return what `row(model, data, goal)` is in every environment."""
    goals = lifting(env).target_pos.numpy()
    found = [row(*host(env, index), goals[index]) for index in range(env.num_envs)]
    return torch.tensor(np.array(found), dtype=torch.float32)


def close(found: torch.Tensor, expected: torch.Tensor) -> None:
    assert expected.abs().max() > 1e-2
    torch.testing.assert_close(found, expected, atol=2e-5, rtol=1e-4)


def test_the_object_is_seen_from_the_hand_in_the_frame_of_the_root(env, hand):
    def row(model, data, goal):
        root = data.xmat[model.body("robot/arm").id].reshape(3, 3)
        return root.T @ (data.body("cube/cube").xpos - data.site(SITE).xpos)

    close(mdp.ee_to_object_distance(env, "cube", hand), rows(env, row))


def test_the_goal_is_seen_from_the_object_in_the_frame_of_the_root(env):
    def row(model, data, goal):
        root = data.xmat[model.body("robot/arm").id].reshape(3, 3)
        return root.T @ (goal - data.body("cube/cube").xpos)

    close(mdp.object_to_goal_distance(env, "cube", "lift_height"), rows(env, row))


def test_the_object_of_the_command_is_seen_as_any_object(env, hand):
    assert torch.equal(
        mdp.ee_to_target_object(env, "lift_height", hand),
        mdp.ee_to_object_distance(env, "cube", hand),
    )
    assert torch.equal(
        mdp.target_object_to_goal(env, "lift_height"),
        mdp.object_to_goal_distance(env, "cube", "lift_height"),
    )


def test_the_goal_is_seen_from_the_hand_in_the_frame_of_the_hand(env, hand):
    def row(model, data, goal):
        return data.site(SITE).xmat.reshape(3, 3).T @ (goal - data.site(SITE).xpos)

    close(mdp.target_position(env, "lift_height", hand), rows(env, row))


def test_the_velocity_of_the_hand_is_in_its_own_frame(env, hand):
    def row(model, data, goal):
        velocity = np.zeros(6)
        kind = mujoco.mjtObj.mjOBJ_SITE
        mujoco.mj_objectVelocity(model, data, kind, model.site(SITE).id, velocity, 1)
        return velocity[3:]

    close(mdp.ee_velocity(env, hand), rows(env, row))


def test_a_new_goal_is_observed_in_the_step_in_which_it_comes(make_env):
    def edit(cfg):
        cfg.commands["lift_height"].resampling_time_range = (0.1, 0.1)
        cfg.observations["actor"].enable_corruption = False

    env = make_env(edit=edit)
    env.reset()
    for _ in range(12):
        observed = env.step(torch.zeros(4, 7))[0]["actor"][:, 16:22]
        cube, hand = env.scene["cube"].data, env.scene["robot"].data
        site = env.scene["robot"].site_names.index("grasp_site")
        # qpos holds the pose written for the cube; the base is not rotated.
        position = env.sim.data.qpos[:, 8:11]
        torch.testing.assert_close(cube.root_link_pos_w, position, atol=1e-6, rtol=0)
        expected = torch.cat(
            (position - hand.site_pos_w[:, site], lifting(env).target_pos - position), dim=1
        )
        torch.testing.assert_close(observed, expected, atol=1e-5, rtol=0)
    assert (lifting(env).command_counter > 2).all()


# Commands of the wrong kind.


def test_terms_ask_for_the_kind_of_command_that_they_read(env):
    single = lifting(env)
    _, multi = multi_cube_command()
    stand_in: Any = SimpleNamespace(
        scene=env.scene, device="cpu", command_manager=SimpleNamespace(get_term=lambda _: multi)
    )
    with pytest.raises(TypeError, match="'lift_height': expected LiftingCommand, got MultiCube"):
        mdp.object_to_goal_distance(stand_in, "cube", "lift_height")
    with pytest.raises(TypeError, match="expected LiftingCommand"):
        mdp.staged_position_reward(stand_in, "lift_height", "cube", 0.1, 0.1)
    stand_in.command_manager.get_term = lambda _: single
    for term in (
        lambda: mdp.multi_cube_bring_object_reward(stand_in, "lift_height", 0.1),
        lambda: mdp.multi_cube_staged_position_reward(stand_in, "lift_height", 0.1, 0.1),
        lambda: mdp.camera_target_cube_mask(stand_in, "camera", "lift_height"),
    ):
        with pytest.raises(TypeError, match="expected MultiCubeLiftingCommand"):
            term()
    stand_in.command_manager.get_term = lambda _: object()
    with pytest.raises(TypeError, match="expected LiftingCommand or MultiCubeLiftingCommand"):
        mdp.target_position(stand_in, "lift_height")


# Images.


def camera(**images: torch.Tensor) -> Any:
    """Return a stand-in whose sensor `camera` gives these images."""
    fields = {"rgb": None, "depth": None, "segmentation": None, **images}
    sensor = SimpleNamespace(data=SimpleNamespace(**fields))
    return SimpleNamespace(scene={"camera": sensor})


def test_colors_are_fractions_with_channels_first():
    rgb = torch.randint(0, 256, (2, 4, 5, 3), dtype=torch.uint8)
    seen = mdp.camera_rgb(camera(rgb=rgb), "camera")
    assert seen.shape == (2, 3, 4, 5)
    for channel in range(3):
        torch.testing.assert_close(seen[:, channel], rgb[..., channel] / 255.0)


def test_depth_is_a_share_of_the_cutoff_and_the_background_is_far():
    depths = [0.001, 0.01, 0.25, 0.5, 7.0, 0.0, float("inf"), float("nan")]
    image = torch.tensor(depths).view(1, 2, 4, 1)
    seen = mdp.camera_depth(camera(depth=image), "camera", cutoff_distance=0.5, min_depth=0.01)
    assert seen.shape == (1, 1, 2, 4)
    # A depth of 0 is a ray that hit nothing. As a number it would be nearer than anything.
    assert seen.flatten().tolist() == pytest.approx([0.02, 0.02, 0.5, 1.0, 1.0, 1.0, 1.0, 1.0])
    # The image of the sensor is unchanged.
    assert image.flatten()[:5].tolist() == pytest.approx(depths[:5])


def test_segmentation_keeps_ids_and_types():
    image = torch.randint(-1, 9, (2, 4, 5, 2), dtype=torch.int32)
    seen = mdp.camera_segmentation(camera(segmentation=image), "camera")
    assert seen.shape == (2, 2, 4, 5)
    assert seen.dtype == torch.int32
    assert torch.equal(seen[:, 0], image[..., 0])
    assert torch.equal(seen[:, 1], image[..., 1])


def test_the_mask_is_of_the_wanted_cubes_geoms_and_of_nothing_else():
    stand_in, term = multi_cube_command(cubes(count=3, num_envs=2))
    term.target_selection[:] = torch.tensor([1, 2])
    geom, site = int(mujoco.mjtObj.mjOBJ_GEOM), int(mujoco.mjtObj.mjOBJ_SITE)
    # Geoms 0 to 3, a site with the id of the wanted geom, and background.
    pixels = [(0, geom), (1, geom), (2, geom), (3, geom), (1, site), (2, site), (-1, -1)]
    image = torch.tensor(pixels, dtype=torch.int32).view(1, 1, 7, 2).expand(2, 1, 7, 2)
    seen_by: Any = camera(segmentation=image)
    seen_by.command_manager = stand_in.command_manager
    mask = mdp.camera_target_cube_mask(seen_by, "camera", "lift_height")
    assert mask.shape == (2, 1, 1, 7)
    assert mask.flatten(start_dim=1).tolist() == [[0, 1, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0, 0]]


def test_hand_object_and_command_are_checked_when_the_environment_is_built(make_env):
    for term, params, error, message in (
        ("ee_to_cube", {"object_name": "cub"}, KeyError, "'cub'.*'cube'"),
        ("ee_to_cube", {"asset_cfg": SceneEntityCfg("robot")}, ValueError, "asset_cfg: .*got 2"),
        ("cube_to_goal", {"object_name": "cub"}, KeyError, "'cub'.*'cube'"),
        ("cube_to_goal", {"command_name": "lift"}, KeyError, "'lift'.*'lift_height'"),
    ):

        def edit(cfg, term=term, params=params):
            cfg.observations["actor"].terms[term].params.update(copy.deepcopy(params))

        with pytest.raises(error, match=f"actor/{term}': .*{message}"):
            make_env(edit=edit)


def test_a_term_about_one_cube_is_refused_where_there_are_several(make_env):
    def edit(cfg):
        params = {"object_name": "cube_0", "command_name": "lift_height"}
        cfg.observations["critic"].terms["cube_to_goal"] = ObservationTermCfg(
            func=mdp.object_to_goal_distance, params=params
        )

    with pytest.raises(
        TypeError, match="critic/cube_to_goal'.*expected LiftingCommand, got MultiCube"
    ):
        make_env(MULTI, edit=edit, images=False)


# Images as the tasks have them.


@pytest.mark.parametrize(("task", "channels"), [(RGB, 3), (DEPTH, 1), (MULTI, 2)])
def test_images_have_the_channels_of_the_task_and_show_something(make_env, task, channels):
    env = make_env(task, num_envs=3)
    image = env.reset()[0]["camera"]
    assert image.shape == (3, channels, 32, 32)
    assert ((image >= 0.0) & (image <= 1.0)).all()
    assert (image.flatten(start_dim=2).std(dim=-1) > 0.0).any(dim=0).all()


def test_the_mask_shows_the_cube_under_the_hand_if_it_is_the_wanted_one(make_env):
    env = make_env(MULTI, num_envs=3)
    env.reset()
    site = env.scene["robot"].site_names.index("grasp_site")
    hand = env.scene["robot"].data.site_pos_w[:, site]
    pose = torch.zeros(3, 7)
    pose[:, 3] = 1.0
    for index in range(3):
        # The first cube is between the fingers, the others are behind the arm.
        pose[:, :3] = hand if index == 0 else env.scene.env_origins - torch.tensor([0.4, 0.0, 0.0])
        env.scene[f"cube_{index}"].write_root_link_pose_to_sim(pose)
    lifting(env).target_selection[:] = torch.tensor([0, 1, 2])
    env.sim.forward()
    env.sim.sense()
    mask = mdp.camera_target_cube_mask(env, "camera_d405", "lift_height")[:, 0]
    depth = mdp.camera_depth(env, "camera_d405", cutoff_distance=0.5)[:, 0]
    assert mask[0].sum() > 40
    assert mask[1:].sum() == 0
    # The masked pixels show the cube. The cube is nearer than the ground.
    assert depth[0][mask[0] > 0].max() < 0.5
    assert depth[1:].max() > 0.5
