"""Learners by name, and conversion of configs between learners."""

from __future__ import annotations

import copy
from dataclasses import asdict, fields, replace
from typing import Any, Literal, get_args

from mjlab.rl.config import (
    EvaluationCfg,
    RslRlBaseRunnerCfg,
    RslRlDistillationRunnerCfg,
    RslRlModelCfg,
    RslRlOffPolicyRunnerCfg,
    RslRlOnPolicyRunnerCfg,
)
from mjlab.utils.errors import check_exists

Learner = Literal["ppo", "sac", "distillation"]

_MIRROR_FUNCTION = "data_augmentation_func"
# Fields of a run with learner-specific values.
_PACE = frozenset(("num_steps_per_env", "max_iterations", "save_interval"))
# Keys that releases 1.x do not have, with their defaults.
_ADDED: dict[str, Any] = {
    "torch_compile_mode": None,
    "save_git_diff": True,
    "upload_git_diff": False,
    "evaluation": asdict(EvaluationCfg()),
    "annealing": ((0, 1.0),),
}
_ADDED_TO_ALGORITHM = {
    "symmetry_cfg": None,
    "use_mixed_precision": False,
    "teacher_iterations": 0,
}


def learner_of(cfg: RslRlBaseRunnerCfg) -> Learner:
    """Return the learner of a config; `ppo` by default."""
    if isinstance(cfg, RslRlDistillationRunnerCfg):
        return "distillation"
    return "sac" if isinstance(cfg, RslRlOffPolicyRunnerCfg) else "ppo"


def with_learner(cfg: RslRlBaseRunnerCfg, learner: Learner) -> RslRlBaseRunnerCfg:
    """Return `cfg` if its learner is `learner`, else a config of `learner` for the same run.

    The fields of `RslRlBaseRunnerCfg` and the symmetry function are copied. Networks and algorithm
    have the learner's defaults, except for SAC's `action_bounds`, `joint_ranges`, and for
    distillation: the teacher is the actor of `cfg`, and the student has the same network and
    observations.

    Raises:
        ValueError: the learner is unknown; or is SAC, and a network of `cfg` is recurrent or has an
            image encoder; or is distillation, and the learner of `cfg` is not PPO.
    """
    check_exists("learner", learner, get_args(Learner))
    if learner_of(cfg) == learner:
        return cfg
    base = _shared_fields(cfg, learner)
    if learner == "distillation":
        if learner_of(cfg) != "ppo":
            raise ValueError(
                f"distillation: expected a teacher trained with the learner 'ppo', got "
                f"{learner_of(cfg)!r}; use a different profile, or no profile."
            )
        teacher: RslRlModelCfg = copy.deepcopy(getattr(cfg, "actor", RslRlModelCfg()))
        groups = cfg.obs_groups.get("actor", ("actor",))
        made = RslRlDistillationRunnerCfg(**base)
        made.obs_groups = {"student": groups, "teacher": groups}
        steps = made.num_steps_per_env
        made.algorithm.gradient_length = max(k for k in range(1, 9) if steps % k == 0)
        made.teacher = teacher
        made.student = replace(
            copy.deepcopy(teacher), distribution_cfg=made.student.distribution_cfg
        )
        return made
    symmetry = getattr(getattr(cfg, "algorithm", None), "symmetry_cfg", None)
    if learner == "sac":
        for name in ("actor", "critic"):
            for field, kind in (
                ("rnn_type", "a recurrent one"),
                ("cnn_cfg", "one that sees images"),
            ):
                if getattr(getattr(cfg, name, None), field, None):
                    raise ValueError(
                        f"agent.{name}: expected a network of flat observations for the learner 'sac', "
                        f"got {kind} ({field}); use --learner ppo."
                    )
        off_policy = RslRlOffPolicyRunnerCfg(**base)
        # Scales are made for unbounded actions: the YAM's PPO uses six of them.
        off_policy.algorithm.action_bounds = "joint_ranges"
        if symmetry:
            off_policy.algorithm.symmetry_cfg = {_MIRROR_FUNCTION: symmetry[_MIRROR_FUNCTION]}
        return off_policy
    on_policy = RslRlOnPolicyRunnerCfg(**base)
    if symmetry:
        on_policy.algorithm.symmetry_cfg = {**symmetry, "use_data_augmentation": True}
    return on_policy


def for_task_of(cfg: RslRlBaseRunnerCfg, other: RslRlBaseRunnerCfg) -> RslRlBaseRunnerCfg:
    """Return a copy of `cfg` with the task-specific fields of `other`, such as its evaluation.

    The number of iterations, steps per iteration and save interval are those of `cfg`, as are the
    observation groups if the networks have different names.
    """
    cfg = copy.deepcopy(cfg)
    for name, value in _shared_fields(other, learner_of(cfg)).items():
        if name not in _PACE:
            setattr(cfg, name, value)
    return cfg


def train_dict(cfg: RslRlBaseRunnerCfg) -> dict[str, Any]:
    """Return `cfg` as the dict of a runner, without unchanged additions to releases 1.x."""
    made = asdict(cfg)
    drop_unchanged_additions(made)
    return made


def drop_unchanged_additions(cfg: dict[str, Any]) -> None:
    """Remove keys that releases 1.x do not have from a runner's dict, in place, if unchanged.

    Runners and algorithms of other packages may reject keys that they do not know.
    """
    for part, added in ((cfg, _ADDED), (cfg["algorithm"], _ADDED_TO_ALGORITHM)):
        for name in [name for name in added if name in part and part[name] == added[name]]:
            del part[name]


def acting_cfg(cfg: RslRlBaseRunnerCfg) -> dict[str, Any]:
    """Return `cfg` as the dict of a runner that acts but does not learn: with a replay of one step."""
    acting = train_dict(cfg)
    if learner_of(cfg) == "sac":
        acting["algorithm"]["replay_steps"] = 1
    return acting


def _shared_fields(cfg: RslRlBaseRunnerCfg, learner: Learner) -> dict[str, Any]:
    """Return copies of the fields that `cfg` shares with a config of `learner`.

    The observation groups are left out if the networks have different names.
    """
    shared = {
        field.name: copy.deepcopy(getattr(cfg, field.name)) for field in fields(RslRlBaseRunnerCfg)
    }
    if (learner_of(cfg) == "distillation") != (learner == "distillation"):
        del shared["obs_groups"]
    return shared
