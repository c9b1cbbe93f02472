"""Manipulation tasks of the YAM arm."""

from __future__ import annotations

import colorsys
import copy
from dataclasses import dataclass
from typing import Literal

import mujoco

from mjlab.asset_zoo.robots import get_yam_robot_cfg
from mjlab.asset_zoo.robots.i2rt_yam.yam_constants import YAM_ACTION_SCALE
from mjlab.entity import EntityCfg
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.managers import (
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    SceneEntityCfg,
)
from mjlab.sensor import CameraSensorCfg, ContactSensorCfg
from mjlab.tasks.manipulation import mdp
from mjlab.tasks.manipulation.lift_cube_env_cfg import make_lift_cube_env_cfg
from mjlab.utils.errors import check_count, check_one_of

_HAND = ("grasp_site",)
_FINGERTIPS = "[lr]f_down(6|7|8|9|10|11)_collision"
_CAMERA = "camera_d405"
_IMAGE_SIZE = 32
# Geom groups in camera images: ground and cubes (0), collision geoms of the arm (3).
_SEEN_GROUPS = (0, 3)
_DEPTH_IMAGE = ObservationTermCfg(
    func=mdp.camera_depth, params={"sensor_name": _CAMERA, "cutoff_distance": 0.5}
)
_PLAY_GOAL_TIME = 4.0
# Warp contacts to reserve per cube: cubes can touch the whole gripper and the other cubes.
_CONTACTS_PER_CUBE = 120


def get_cube_spec(
    cube_size: float = 0.02,
    mass: float = 0.05,
    rgba: tuple[float, float, float, float] = (0.8, 0.2, 0.2, 1.0),
) -> mujoco.MjSpec:
    """Return a new spec of a cube with a free joint.

    Args:
        cube_size: Half-length of an edge (m).
        mass: Mass (kg).
        rgba: Color and opacity.
    """
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="cube")
    body.add_freejoint(name="cube_joint")
    body.add_geom(
        name="cube_geom",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=(cube_size,) * 3,
        mass=mass,
        rgba=rgba,
    )
    return spec


@dataclass(frozen=True)
class _ColoredCube:
    """Picklable and comparable `spec_fn`, as configs require."""

    rgba: tuple[float, float, float, float]

    def __call__(self) -> mujoco.MjSpec:
        return get_cube_spec(rgba=self.rgba)


def yam_lift_cube_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the config of the state-based task, for training or `play`."""
    cfg = make_lift_cube_env_cfg()
    action = cfg.actions["joint_pos"]
    assert isinstance(action, mdp.JointPositionActionCfg)
    cfg.scene.entities = {"robot": get_yam_robot_cfg(), "cube": EntityCfg(spec_fn=get_cube_spec)}
    action.scale = dict(YAM_ACTION_SCALE)
    actor, critic = cfg.observations["actor"], cfg.observations["critic"]
    for term in (actor.terms["ee_to_cube"], critic.terms["ee_to_cube"], cfg.rewards["lift"]):
        term.params["asset_cfg"].site_names = _HAND
    for name in ("slide", "spin", "roll"):
        cfg.events[f"fingertip_friction_{name}"].params["asset_cfg"].geom_names = _FINGERTIPS
    (hand_on_the_ground,) = cfg.scene.sensors
    assert isinstance(hand_on_the_ground, ContactSensorCfg)
    hand_on_the_ground.primary.pattern = "link_6"
    cfg.viewer.body_name = "arm"
    if play:
        cfg.episode_length_s = int(1e9)
        actor.enable_corruption = False
        cfg.curriculum = {}
        cfg.commands["lift_height"].resampling_time_range = (_PLAY_GOAL_TIME, _PLAY_GOAL_TIME)
    return cfg


def yam_lift_cube_vision_env_cfg(
    cam_type: Literal["rgb", "depth"], play: bool = False
) -> ManagerBasedRlEnvCfg:
    """Return the config of the task with wrist camera images, for training or `play`.

    The actor observes the cube in the image only; the critic also observes its position.

    Raises:
        ValueError: `cam_type` is neither `rgb` nor `depth`.
    """
    check_one_of("cam_type", cam_type, ("rgb", "depth"))
    cfg = yam_lift_cube_env_cfg(play=play)
    cfg.scene.sensors += (_camera((cam_type,)),)
    if cam_type == "rgb":
        image = ObservationTermCfg(func=mdp.camera_rgb, params={"sensor_name": _CAMERA})
        cfg.events["cube_color"] = EventTermCfg(
            func=mdp.dr.geom_rgba,
            mode="reset",
            params={
                "asset_cfg": SceneEntityCfg("cube", geom_names=(".*",)),
                "operation": "abs",
                "distribution": "uniform",
                "axes": [0, 1, 2],
                "ranges": (0.0, 1.0),
            },
        )
    else:
        image = copy.deepcopy(_DEPTH_IMAGE)
    cfg.observations["camera"] = ObservationGroupCfg(
        terms={f"{_CAMERA}_{cam_type}": image}, enable_corruption=False
    )
    _replace_cube_by_goal(cfg, "actor")
    return cfg


def yam_lift_cube_rgb_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the config of the task with RGB images."""
    return yam_lift_cube_vision_env_cfg("rgb", play=play)


def yam_lift_cube_depth_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the config of the task with depth images."""
    return yam_lift_cube_vision_env_cfg("depth", play=play)


def yam_multi_cube_seg_env_cfg(num_cubes: int = 3, play: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the config of lifting one of several cubes, for training or `play`.

    Image observations are depth and a mask of the target cube.

    Raises:
        ValueError: `num_cubes` is below 1.
    """
    check_count("num_cubes", num_cubes)
    cfg = yam_lift_cube_env_cfg(play=play)
    del cfg.scene.entities["cube"]
    cubes = tuple(f"cube_{index}" for index in range(num_cubes))
    for index, name in enumerate(cubes):
        color = (*colorsys.hsv_to_rgb(index / num_cubes, 0.8, 0.9), 1.0)
        cfg.scene.entities[name] = EntityCfg(spec_fn=_ColoredCube(color))
    cfg.sim.nconmax = max(cfg.sim.nconmax or 0, 55 + _CONTACTS_PER_CUBE * num_cubes)
    single = cfg.commands["lift_height"]
    assert isinstance(single, mdp.LiftingCommandCfg)
    cfg.commands["lift_height"] = mdp.MultiCubeLiftingCommandCfg(
        entity_names=cubes,
        resampling_time_range=single.resampling_time_range,
        debug_vis=single.debug_vis,
        difficulty=single.difficulty,
    )
    cfg.rewards["lift"].func = mdp.multi_cube_staged_position_reward
    cfg.rewards["lift_precise"].func = mdp.multi_cube_bring_object_reward
    for name in ("lift", "lift_precise"):
        del cfg.rewards[name].params["object_name"]
    cfg.scene.sensors += (_camera(("depth", "segmentation")),)
    mask = ObservationTermCfg(
        func=mdp.camera_target_cube_mask,
        params={"sensor_name": _CAMERA, "command_name": "lift_height"},
    )
    cfg.observations["camera"] = ObservationGroupCfg(
        terms={"depth": copy.deepcopy(_DEPTH_IMAGE), "target_mask": mask},
        enable_corruption=False,
        # Channels; the batch dimension does not count.
        concatenate_dim=0,
    )
    _replace_cube_by_goal(cfg, "actor")
    _replace_cube_by_goal(cfg, "critic")
    return cfg


def _replace_cube_by_goal(cfg: ManagerBasedRlEnvCfg, group: str) -> None:
    """Replace the cube terms of an observation group by the goal position in the hand frame."""
    terms = cfg.observations[group].terms
    del terms["ee_to_cube"], terms["cube_to_goal"]
    terms["goal_position"] = ObservationTermCfg(
        func=mdp.target_position,
        params={
            "command_name": "lift_height",
            "asset_cfg": SceneEntityCfg("robot", site_names=_HAND),
        },
    )


def _camera(data_types: tuple[Literal["rgb", "depth", "segmentation"], ...]) -> CameraSensorCfg:
    return CameraSensorCfg(
        name=_CAMERA,
        camera_name=f"robot/{_CAMERA}",
        width=_IMAGE_SIZE,
        height=_IMAGE_SIZE,
        data_types=data_types,
        use_textures=True,
        use_shadows=False,
        enabled_geom_groups=_SEEN_GROUPS,
    )
