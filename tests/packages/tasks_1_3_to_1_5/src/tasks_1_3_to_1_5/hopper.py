"""The hopper, its configs written by position where release 1.5 takes positions."""

from __future__ import annotations

from pathlib import Path

import mujoco

from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.utils.spec_config import CollisionCfg

BODIES = ("torso", "thigh", "shank")


def get_spec() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(Path(__file__).parent / "hopper.xml"))


def get_hopper_cfg() -> EntityCfg:
    legs = BuiltinPositionActuatorCfg(
        target_names_expr=("hip", "knee"), stiffness=40.0, damping=1.0, effort_limit=30.0
    )
    return EntityCfg(
        EntityCfg.InitialStateCfg((0.0, 0.0, 0.57)),
        get_spec,
        EntityArticulationInfoCfg((legs,), 0.9),
        collisions=(
            CollisionCfg(
                (".*_collision",),
                contype={"foot_collision": 1, "torso_collision": 1},
                conaffinity=1,
                condim={"foot_collision": 3},
                priority={"foot_collision": 1},
                friction={"foot_collision": (0.9,)},
            ),
        ),
    )
