"""Describe a task by tables of its terms: `uv run mjlab describe TASK [flags]`."""

from __future__ import annotations

import copy
import json
import shutil
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from mjlab.cli.flags import (
    parse_flags,
    prepare_env_cfg,
    previewed,
    with_task_options,
)
from mjlab.deploy.terms import unmeasured_table
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.tasks.registry import list_profiles, load_env_cfg, load_rl_cfg
from mjlab.utils.config_json import config_json, signatures_json
from mjlab.utils.errors import BadCallError
from mjlab.utils.screen import shown
from mjlab.utils.string import counted
from mjlab.utils.tables import WIDTH, json_value, tables_text

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.own_robot.findings import Finding

_MIN_WIDTH = 80


@dataclass
class ConfigChoice:
    """Flags that select the config of a task."""

    profile: str | None = field(default=None, metadata=shown("run", "NAME"))
    """Task profile, such as `cpu`."""
    play: bool = field(default=False, metadata=shown("run"))
    """Describe the environment of `play` instead of that of `train`."""


@dataclass
class DescribeConfig(ConfigChoice):
    """Flags of `describe`."""

    json: bool = field(default=False, metadata=shown("run"))
    """Print JSON: all columns, lists in full, and what a config is written from."""
    markdown: bool = field(default=False, metadata=shown("run"))
    """Print Markdown."""
    check: bool = field(default=False, metadata=shown("run"))
    """Add the findings of `mjlab check`."""
    env: ManagerBasedRlEnvCfg | None = None
    """Environment. None: config of the task."""


def command(argv: list[str], prog: str) -> None:
    """Run `describe`."""
    task, *flags = argv
    # The defaults of the other flags depend on these two.
    choice = previewed(ConfigChoice(), flags)
    env_cfg = load_env_cfg(task, choice.play, choice.profile)
    default = with_task_options(DescribeConfig(choice.profile, choice.play, env=env_cfg), task)
    cfg = parse_flags(type(default), default, flags, f"{prog} {task}")
    if cfg.json and cfg.markdown:
        raise BadCallError("describe: expected one of --json and --markdown, got both.")
    description = describe(task, cfg)
    findings = _findings(cfg.env or env_cfg) if cfg.check else None
    if cfg.json:
        found = {} if findings is None else {"findings": [asdict(one) for one in findings]}
        print(json.dumps(description.as_json() | found, indent=2, allow_nan=False))
        return
    if cfg.markdown:
        print(description.markdown())
    else:
        columns = shutil.get_terminal_size((WIDTH, 24)).columns
        print(description.text(min(max(columns, _MIN_WIDTH), WIDTH)))
    if findings is not None:
        from mjlab.scripts.check import report

        print(f"\n{report(task, findings)}")


def _findings(env_cfg: ManagerBasedRlEnvCfg) -> list[Finding]:
    from mjlab.scripts.check import check_task

    return check_task(env_cfg)


def describe(task: str, cfg: DescribeConfig | None = None) -> TaskDescription:
    """Return the description of a task, read from one environment built on the CPU.

    Args:
        task: Name of the task.
        cfg: Flags. None: the defaults.

    Raises:
        UnknownTaskError, UnknownProfileError: unknown task or profile.
        ValueError: invalid config, or a resource of the task was not found.
    """
    cfg = cfg or DescribeConfig()
    env_cfg = copy.deepcopy(cfg.env) or load_env_cfg(task, cfg.play, cfg.profile)
    prepare_env_cfg(task, cfg, env_cfg, checkpoint=None)
    built_cfg = copy.deepcopy(env_cfg)
    built_cfg.scene.num_envs = 1
    # Tasks that require a GPU are described without one.
    built_cfg.sim.engine = "auto"
    env = ManagerBasedRlEnv(built_cfg, device="cpu")
    try:
        return TaskDescription(task, cfg, env_cfg, env)
    finally:
        env.close()


class TaskDescription:
    """Tables of a task.

    Args:
        task: Name of the task.
        cfg: Flags with profile and purpose.
        env_cfg: Config of the environment.
        env: Environment of the task with any number of environments.
    """

    def __init__(
        self, task: str, cfg: DescribeConfig, env_cfg: ManagerBasedRlEnvCfg, env: ManagerBasedRlEnv
    ) -> None:
        self.task = task
        self._profile = cfg.profile
        self._env_cfg = env_cfg
        self._parts = {name: _parts(entity) for name, entity in env.scene.entities.items()}
        num_envs = env_cfg.scene.num_envs
        observations, *others = env.tables()
        self.tables = [observations, unmeasured_table(env), *others]
        self._facts = {
            "task": task,
            "profiles": list_profiles(task),
            "profile": cfg.profile,
            "play": cfg.play,
            "num_envs": num_envs,
            "physics_dt": env.physics_dt,
            "decimation": env.cfg.decimation,
            "step_dt": env.step_dt,
            "episode_length_s": env.max_episode_length_s,
            "max_episode_length": env.max_episode_length,
            "observation_shapes": env.observation_manager.group_obs_dim,
            "action_size": env.action_manager.total_action_dim,
        }
        variant = [f"profile {cfg.profile}"] * (cfg.profile is not None) + ["play"] * cfg.play
        self._name = ", ".join([task, *variant])
        self._summary = f"{counted(num_envs, 'environment')} by default; {env.describe_time()}."

    def as_json(self) -> dict[str, Any]:
        """Return all that a config is written from, as JSON values.

        Sizes and times, the rows of each table, the parts of each entity by name, the configs of the
        environment and of the learner, and the functions and classes in them.
        """
        rl_cfg = load_rl_cfg(self.task, profile=self._profile)
        return {
            **json_value(self._facts),
            **{table.name: table.records() for table in self.tables},
            "parts": json_value(self._parts),
            "env_cfg": config_json(self._env_cfg),
            "rl_cfg": config_json(rl_cfg),
            "functions": signatures_json(self._env_cfg, rl_cfg),
        }

    def text(self, width: int = WIDTH) -> str:
        """Return the tables as text of at most `width` characters per line."""
        return f"{self._name}\n{self._summary}\n\n{tables_text(self.tables, width)}"

    def markdown(self) -> str:
        """Return the tables in Markdown, under a heading of level 2."""
        parts = [f"## {self._name}", self._summary]
        for table in self.tables:
            if table.rows:
                parts += [f"**{table.title}**", table.markdown()]
        return "\n\n".join(parts)


def _parts(entity: Entity) -> dict[str, Any]:
    """Return the names of an entity's parts, and range and initial position of its joints."""
    joints = {}
    if entity.num_joints:
        data = entity.data
        limits, initial = data.joint_pos_limits[0], data.default_joint_pos[0]
        for name, bounds, position in zip(entity.joint_names, limits, initial, strict=True):
            joints[name] = {"range": bounds, "initial": position}
    return {
        "joints": joints,
        "actuators": entity.actuator_names,
        "bodies": entity.body_names,
        "geoms": list(filter(None, entity.geom_names)),
        "sites": entity.site_names,
    }
