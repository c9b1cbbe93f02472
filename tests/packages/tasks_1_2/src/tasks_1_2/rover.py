"""A rover with two driven wheels that drives at the commanded velocity."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import torch

from mjlab.actuator import XmlVelocityActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.envs.mdp import dr
from mjlab.envs.mdp.actions import JointVelocityActionCfg
from mjlab.envs.mdp.events import apply_body_impulse
from mjlab.managers import (
    CurriculumTermCfg,
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
)
from mjlab.rl import RslRlModelCfg, RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg
from mjlab.scene import SceneCfg
from mjlab.sensor import (
    ContactMatch,
    ContactSensorCfg,
    GridPatternCfg,
    ObjRef,
    RayCastSensorCfg,
)
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.tasks.velocity import mdp
from mjlab.tasks.velocity.mdp import UniformVelocityCommand, UniformVelocityCommandCfg
from mjlab.terrains import TerrainImporterCfg

_WHEELS = (".*_wheel",)


def get_spec() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(Path(__file__).parent / "rover.xml"))


class SmoothVelocityCommand(UniformVelocityCommand):
    """Velocity command that approaches what was drawn; by how much, an argument says."""

    def __init__(self, cfg: SmoothVelocityCommandCfg, env):
        super().__init__(cfg, env)
        self.smooth_b = torch.zeros_like(self.vel_command_b)

    @property
    def command(self) -> torch.Tensor:
        return self.smooth_b

    def _update_command(self, gain: float = 0.2, *, settle: bool = False) -> None:
        super()._update_command()
        self.smooth_b += (1.0 if settle else gain) * (self.vel_command_b - self.smooth_b)


@dataclass(kw_only=True)
class SmoothVelocityCommandCfg(UniformVelocityCommandCfg):
    def build(self, env) -> SmoothVelocityCommand:
        return SmoothVelocityCommand(self, env)


def _wheel_sites() -> SceneEntityCfg:
    return SceneEntityCfg("robot", site_names=(".*_tread",))


_SENSORS = (
    ContactSensorCfg(
        name="wheels_ground",
        primary=ContactMatch(mode="geom", pattern=_WHEELS, entity="robot"),
        secondary=ContactMatch(mode="body", pattern="terrain"),
        track_air_time=True,
    ),
    # Two patterns need the policy "any", which counts contacts with anything.
    ContactSensorCfg(
        name="wheels_body",
        primary=ContactMatch(mode="geom", pattern=_WHEELS, entity="robot"),
        secondary=ContactMatch(mode="geom", pattern=("bumper", "deck"), entity="robot"),
        secondary_policy="any",
        fields=("found",),
    ),
    # As in the velocity template of this release, with the default geom groups.
    RayCastSensorCfg(
        name="terrain_scan",
        frame=ObjRef(type="body", name="chassis", entity="robot"),
        ray_alignment="yaw",
        pattern=GridPatternCfg(size=(0.6, 0.4), resolution=0.2),
        max_distance=5.0,
        exclude_parent_body=True,
    ),
)


def rover_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    terms = {
        "lin_vel": ObservationTermCfg(func=mdp.base_lin_vel),
        "ang_vel": ObservationTermCfg(func=mdp.base_ang_vel),
        "wheel_vel": ObservationTermCfg(func=mdp.joint_vel_rel),
        "command": ObservationTermCfg(
            func=mdp.generated_commands, params={"command_name": "twist"}
        ),
        "actions": ObservationTermCfg(func=mdp.last_action),
    }
    critic_terms = {
        **terms,
        "scan": ObservationTermCfg(func=mdp.height_scan, params={"sensor_name": "terrain_scan"}),
        "wheel_height": ObservationTermCfg(
            func=mdp.foot_height, params={"asset_cfg": _wheel_sites()}
        ),
    }
    return ManagerBasedRlEnvCfg(
        decimation=4,
        episode_length_s=5.0,
        scene=SceneCfg(
            terrain=TerrainImporterCfg(terrain_type="plane"),
            entities={
                "robot": EntityCfg(
                    spec_fn=get_spec,
                    init_state=EntityCfg.InitialStateCfg(pos=(0.0, 0.0, 0.09)),
                    articulation=EntityArticulationInfoCfg(
                        actuators=(XmlVelocityActuatorCfg(target_names_expr=_WHEELS),)
                    ),
                )
            },
            sensors=_SENSORS,
        ),
        observations={
            "actor": ObservationGroupCfg(terms),
            "critic": ObservationGroupCfg(critic_terms),
        },
        actions={
            "wheels": JointVelocityActionCfg(
                entity_name="robot", actuator_names=_WHEELS, scale=10.0
            )
        },
        commands={
            "twist": SmoothVelocityCommandCfg(
                entity_name="robot",
                resampling_time_range=(1.0, 3.0),
                debug_vis=not play,
                ranges=UniformVelocityCommandCfg.Ranges(
                    lin_vel_x=(-0.5, 1.0), lin_vel_y=(0.0, 0.0), ang_vel_z=(-1.0, 1.0)
                ),
            )
        },
        events={
            "reset": EventTermCfg(
                func=mdp.reset_root_state_uniform,
                mode="reset",
                params={"pose_range": {"yaw": (-3.14, 3.14)}, "velocity_range": {}},
            ),
            "friction": EventTermCfg(
                func=dr.geom_friction,
                mode="startup",
                params={
                    "ranges": (0.5, 1.0),
                    "operation": dr.abs,
                    "distribution": dr.log_uniform,
                    "asset_cfg": SceneEntityCfg("robot", geom_names=_WHEELS),
                },
            ),
            "mass": EventTermCfg(
                func=dr.body_mass,
                mode="startup",
                params={
                    "ranges": (0.9, 1.1),
                    "operation": dr.scale,
                    "distribution": dr.uniform,
                    "asset_cfg": SceneEntityCfg("robot", body_names=("chassis",)),
                },
            ),
            "damping": EventTermCfg(
                func=dr.joint_damping,
                mode="reset",
                params={
                    "ranges": (0.01, 0.002),
                    "operation": dr.add,
                    "distribution": dr.gaussian,
                    "asset_cfg": SceneEntityCfg("robot", joint_names=_WHEELS),
                },
            ),
            "impulse": EventTermCfg(
                func=apply_body_impulse,
                mode="step",
                params={
                    "force_range": (-5.0, 5.0),
                    "torque_range": (0.0, 0.0),
                    "duration_s": (0.05, 0.1),
                    "cooldown_s": (0.5, 1.0),
                    "asset_cfg": SceneEntityCfg("robot", body_names=("chassis",)),
                },
            ),
        },
        rewards={
            "lin_vel": RewardTermCfg(
                func=mdp.track_linear_velocity,
                weight=2.0,
                params={"command_name": "twist", "std": 0.5},
            ),
            "upright": RewardTermCfg(
                func=mdp.flat_orientation,
                weight=0.5,
                params={
                    "std": 0.5,
                    "asset_cfg": SceneEntityCfg("robot", body_names=("chassis",)),
                },
            ),
            "clearance": RewardTermCfg(
                func=mdp.feet_clearance,
                weight=-0.1,
                params={"target_height": 0.09, "asset_cfg": _wheel_sites()},
            ),
            "swing_height": RewardTermCfg(
                func=mdp.feet_swing_height,
                weight=-0.1,
                params={
                    "sensor_name": "wheels_ground",
                    "target_height": 0.1,
                    "command_name": "twist",
                    "command_threshold": 0.05,
                    "asset_cfg": _wheel_sites(),
                },
            ),
            "action_rate": RewardTermCfg(func=mdp.action_rate_l2, weight=-0.01),
        },
        curriculum={
            "action_rate": CurriculumTermCfg(
                func=mdp.reward_weight,
                params={
                    "reward_name": "action_rate",
                    "weight_stages": [
                        {"step": 0, "weight": -0.01},
                        {"step": 1000, "weight": -0.05},
                    ],
                },
            )
        },
        terminations={
            "time_out": TerminationTermCfg(func=mdp.time_out, time_out=True),
            "wheels_hit_body": TerminationTermCfg(
                func=mdp.illegal_contact, params={"sensor_name": "wheels_body"}
            ),
        },
        sim=SimulationCfg(nconmax=20, njmax=100, mujoco=MujocoCfg(timestep=0.005)),
    )


def rover_rl_cfg() -> RslRlOnPolicyRunnerCfg:
    return RslRlOnPolicyRunnerCfg(
        actor=RslRlModelCfg(
            hidden_dims=(16,),
            distribution_cfg={
                "class_name": "GaussianDistribution",
                "init_std": 1.0,
                "std_type": "scalar",
            },
        ),
        critic=RslRlModelCfg(hidden_dims=(16,)),
        algorithm=RslRlPpoAlgorithmCfg(num_mini_batches=1),
        experiment_name="tasks_1_2_rover",
        upload_model=False,
    )
