"""Base config of the lifting task: lift a cube to a goal in the air.

Robot packages call `make_lift_cube_env_cfg()` and fill in the robot-specific fields. See
`config/yam`.
"""

from __future__ import annotations

import copy

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.managers import (
    CommandTermCfg,
    CurriculumTermCfg,
    EventTermCfg,
    ObservationGroupCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
)
from mjlab.scene import SceneCfg
from mjlab.sensor import ContactMatch, ContactSensorCfg
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.tasks.manipulation import mdp
from mjlab.tasks.terms import observation
from mjlab.terrains import TerrainEntityCfg
from mjlab.viewer import ViewerConfig

# Placeholders for robot-specific names.
_NO_NAMES: tuple[str, ...] = ()
_NO_BODY = "(body of the hand)"


def make_lift_cube_env_cfg() -> ManagerBasedRlEnvCfg:
    """Return a new config of the task, without a robot and a cube.

    The config shares no objects with other configs and may be edited freely. Fill in:

    - `scene.entities["robot"]` and `scene.entities["cube"]`;
    - the action's scale; the site of the observations `ee_to_cube` and of the reward `lift`; the
      geoms of the events `fingertip_friction_*`; the primary of the sensor `ee_ground_collision`;
    - `viewer.body_name`.

    Building the environment raises for sensors and observations left empty, and warns of events
    without geoms, which change nothing.
    """
    cfg = ManagerBasedRlEnvCfg(
        decimation=4,
        episode_length_s=20.0,
        scene=SceneCfg(
            terrain=TerrainEntityCfg(terrain_type="plane"),
            # Strongest contact between hand and ground, per substep.
            sensors=(
                ContactSensorCfg(
                    name="ee_ground_collision",
                    primary=ContactMatch(mode="subtree", pattern=_NO_BODY, entity="robot"),
                    secondary=ContactMatch(mode="body", pattern="terrain"),
                    fields=("found", "force"),
                    reduce="maxforce",
                    num_slots=1,
                    history_length=4,
                ),
            ),
            num_envs=1,
            env_spacing=1.0,
        ),
        # Critic: same terms without noise, since its group has no corruption.
        observations={
            "actor": ObservationGroupCfg(terms=_TERMS, enable_corruption=True),
            "critic": ObservationGroupCfg(terms=copy.deepcopy(_TERMS)),
        },
        actions={
            "joint_pos": mdp.JointPositionActionCfg(
                entity_name="robot", actuator_names=(".*",), scale=0.5, use_default_offset=True
            )
        },
        commands=_COMMANDS,
        events=_EVENTS,
        rewards=_REWARDS,
        terminations=_TERMINATIONS,
        curriculum=_CURRICULUM,
        sim=SimulationCfg(
            nconmax=55,
            njmax=600,
            mujoco=MujocoCfg(
                timestep=0.005, iterations=10, ls_iterations=20, impratio=10, cone="elliptic"
            ),
        ),
        viewer=ViewerConfig(
            origin_type=ViewerConfig.OriginType.ASSET_BODY,
            entity_name="robot",
            body_name="",
            distance=1.5,
            elevation=-5.0,
            azimuth=120.0,
        ),
    )
    # The sections are module constants.
    return copy.deepcopy(cfg)


# Config sections. `make_lift_cube_env_cfg` copies them.

_TERMS = {
    "joint_pos": observation(mdp.joint_pos_rel, 0.01),
    "joint_vel": observation(mdp.joint_vel_rel, 1.5),
    "ee_to_cube": observation(
        mdp.ee_to_object_distance,
        0.01,
        object_name="cube",
        asset_cfg=SceneEntityCfg("robot", site_names=_NO_NAMES),
    ),
    "cube_to_goal": observation(
        mdp.object_to_goal_distance, 0.01, object_name="cube", command_name="lift_height"
    ),
    "actions": observation(mdp.last_action),
}

_COMMANDS: dict[str, CommandTermCfg] = {
    "lift_height": mdp.LiftingCommandCfg(
        entity_name="cube",
        resampling_time_range=(8.0, 12.0),
        debug_vis=True,
        difficulty="dynamic",
        object_pose_range=mdp.LiftingCommandCfg.ObjectPoseRangeCfg(
            x=(0.2, 0.4), y=(-0.2, 0.2), z=(0.02, 0.05), yaw=(-3.14, 3.14)
        ),
    )
}


def _fingertip_friction(axis: int, ranges: tuple[float, float], distribution: str) -> EventTermCfg:
    return EventTermCfg(
        func=mdp.dr.geom_friction,
        mode="startup",
        params={
            "asset_cfg": SceneEntityCfg("robot", geom_names=_NO_NAMES),
            "operation": "abs",
            "distribution": distribution,
            "axes": [axis],
            "ranges": ranges,
        },
    )


_EVENTS: dict[str, EventTermCfg] = {
    "reset_base": EventTermCfg(
        func=mdp.reset_root_state_uniform,
        mode="reset",
        params={"pose_range": {}, "velocity_range": {}},
    ),
    "reset_robot_joints": EventTermCfg(
        func=mdp.reset_joints_by_offset,
        mode="reset",
        params={
            "position_range": (0.0, 0.0),
            "velocity_range": (0.0, 0.0),
            "asset_cfg": SceneEntityCfg("robot", joint_names=(".*",)),
        },
    ),
    # Fingertips with condim 6 also have torsional and rolling friction. These coefficients span
    # orders of magnitude, hence log-uniform. Each fingertip geom is sampled separately.
    "fingertip_friction_slide": _fingertip_friction(0, (0.3, 1.5), "uniform"),
    "fingertip_friction_spin": _fingertip_friction(1, (1e-4, 2e-2), "log_uniform"),
    "fingertip_friction_roll": _fingertip_friction(2, (1e-5, 5e-3), "log_uniform"),
}

_REWARDS: dict[str, RewardTermCfg] = {
    "lift": RewardTermCfg(
        func=mdp.staged_position_reward,
        weight=1.0,
        params={
            "command_name": "lift_height",
            "object_name": "cube",
            "reaching_std": 0.2,
            "bringing_std": 0.3,
            "asset_cfg": SceneEntityCfg("robot", site_names=_NO_NAMES),
        },
    ),
    "lift_precise": RewardTermCfg(
        func=mdp.bring_object_reward,
        weight=1.0,
        params={"command_name": "lift_height", "object_name": "cube", "std": 0.05},
    ),
    "action_rate_l2": RewardTermCfg(func=mdp.action_rate_l2, weight=-0.01),
    "joint_pos_limits": RewardTermCfg(
        func=mdp.joint_pos_limits,
        weight=-10.0,
        params={"asset_cfg": SceneEntityCfg("robot", joint_names=(".*",))},
    ),
    "joint_vel_hinge": RewardTermCfg(
        func=mdp.joint_velocity_hinge_penalty,
        weight=-0.01,
        params={"max_vel": 0.5, "asset_cfg": SceneEntityCfg("robot", joint_names=(".*",))},
    ),
}

_TERMINATIONS: dict[str, TerminationTermCfg] = {
    "time_out": TerminationTermCfg(func=mdp.time_out, time_out=True),
    "ee_ground_collision": TerminationTermCfg(
        func=mdp.illegal_contact,
        params={"sensor_name": "ee_ground_collision", "force_threshold": 10.0},
    ),
}

# Learn to lift first, then to move gently. Steps are environment steps, 24 per iteration.
_STAGES: list[mdp.RewardCurriculumStage] = [
    {"step": 0, "weight": -0.01},
    {"step": 500 * 24, "weight": -0.1},
    {"step": 1000 * 24, "weight": -1.0},
]
_CURRICULUM: dict[str, CurriculumTermCfg] = {
    "joint_vel_hinge_weight": CurriculumTermCfg(
        func=mdp.reward_curriculum, params={"reward_name": "joint_vel_hinge", "stages": _STAGES}
    )
}
