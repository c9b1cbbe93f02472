"""Parameters of registered tasks equal those of their tables, term for term."""

from __future__ import annotations

import pytest
from task_figures import differences, tables

TABLES = tables()

# Intended deviations from the tables, as lines of the comparison.
DEVIATIONS: dict[str, set[str]] = {
    task: {
        # Success criterion: not part of the 1.6 interface.
        "rl.evaluation is default in the table, and "
        "{'_': 'EvaluationCfg', 'solved_return': 900.0} here",
        # Camera that keeps the whole rail in view: not part of the 1.6 interface.
        "env.viewer.camera is default in the table, and 'cartpole/side' here",
    }
    for task in ("Mjlab-Cartpole-Balance", "Mjlab-Cartpole-Swingup")
}
# Evaluation metrics are not part of the 1.6 interface. Collision sensors report the strongest contact
# instead of an arbitrary one.
_TRACKING_ERRORS = {
    name: f"tasks.velocity.rl.ppo:{name}" for name in ("lin_vel_error", "ang_vel_error")
}
_STANDING_ERRORS = {
    name: f"tasks.velocity.rl.ppo:standing_{name}" for name in ("lin_vel_error", "ang_vel_error")
}
_EVALUATION = {
    "metrics": _TRACKING_ERRORS,
    "standing_still": _STANDING_ERRORS,
    "units": {"lin_vel_error": "m/s", "ang_vel_error": "rad/s"},
}
for task, positions in {
    "Mjlab-Velocity-Flat-Unitree-Go1": [],
    "Mjlab-Velocity-Flat-Unitree-G1": [2],
    "Mjlab-Velocity-Rough-Unitree-G1": [3],
    "Mjlab-Velocity-Rough-Unitree-Go1": [3, 4, 5, 6],
}.items():
    DEVIATIONS[task] = {
        f"env.scene.sensors[{position}].reduce is 'none' in the table, and default here"
        for position in positions
    } | {
        "rl.evaluation is default in the table, and "
        f"{ {'_': 'EvaluationCfg', **_EVALUATION}!r} here"
    }

_PLACEMENT = {
    "success": "mjlab.tasks.manipulation.config.yam.rl_cfg:placed_at_goal",
    "metrics": {
        n: f"tasks.manipulation.config.yam.rl_cfg:{n}" for n in ("position_error", "at_goal")
    },
    "units": {"position_error": "m"},
}
for task in (
    "Mjlab-Lift-Cube-Yam",
    "Mjlab-Lift-Cube-Yam-Rgb",
    "Mjlab-Lift-Cube-Yam-Depth",
    "Mjlab-Multi-Cube-Seg-Yam",
):
    DEVIATIONS[task] = {
        "env.scene.sensors[0].reduce is 'none' in the table, and default here",
        "rl.evaluation is default in the table, and "
        f"{ {'_': 'EvaluationCfg', **_PLACEMENT}!r} here",
    }
# Configs pickle, which those with a lambda do not.
DEVIATIONS["Mjlab-Multi-Cube-Seg-Yam"] |= {
    f"env.scene.entities.{name}.spec_fn is 'tasks.manipulation.config.yam.env_cfgs:"
    "yam_multi_cube_seg_env_cfg.<locals>.<lambda>' in the table, "
    f"{ {'_': '_ColoredCube', 'rgba': rgba}!r} here"
    for name, rgba in (
        ("cube_0", [0.9, 0.17999999999999997, 0.17999999999999997, 1.0]),
        ("cube_1", [0.17999999999999997, 0.9, 0.17999999999999997, 1.0]),
        ("cube_2", [0.17999999999999997, 0.17999999999999997, 0.9, 1.0]),
    )
}
# Motion tracking works without a motion name, ends episodes at the end of the motion, and plays without
# joint noise. Evaluation metrics are not part of the 1.6 interface.
_MOTION_ERRORS = {
    name: f"tasks.tracking.mdp.metrics:{name}"
    for name in ("mpkpe", "r_mpkpe", "joint_vel_error", "ee_pos_error", "ee_ori_error")
}
_MOTION_ENDED = {
    "_": "TerminationTermCfg",
    "func": "tasks.tracking.mdp.terminations:motion_ended",
    "params": {"command_name": "motion"},
    "time_out": True,
}
_MOTION_EVALUATION = {
    "_": "EvaluationCfg",
    "success": "survival",
    "metrics": _MOTION_ERRORS,
    "units": dict(zip(_MOTION_ERRORS, ("m", "m", "rad/s", "m", "rad"), strict=True)),
}
for variant in ("", "-No-State-Estimation"):
    DEVIATIONS[f"Mjlab-Tracking-Flat-Unitree-G1{variant}"] = {
        "env.scene.sensors[0].reduce is 'none' in the table, and default here",
        "env.commands.motion.motion_file is '' in the table, 'squat,wave' here",
        f"env.terminations.motion_ended is default in the table, and {_MOTION_ENDED!r} here",
        f"rl.evaluation is default in the table, and {_MOTION_EVALUATION!r} here",
        "play: commands.motion.joint_position_range is [-0.1, 0.1] in training, [0.0, 0.0] in play",
    }

# 1.6 requires these fields of collisions.
for task, deviations in DEVIATIONS.items():
    if task.endswith(("-Unitree-G1", "-Unitree-Go1", "-No-State-Estimation")):
        deviations |= {
            f"env.scene.entities.robot.collisions[0].{name} is 1 in the table, and default here"
            for name in ("contype", "conaffinity")
        }


@pytest.mark.parametrize("task", TABLES)
def test_the_task_has_the_figures_of_its_table(task):
    assert set(differences(TABLES[task])) == DEVIATIONS.get(task, set())
