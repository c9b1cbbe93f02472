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
from mjlab.tasks.registry import load_env_cfg
from mjlab.utils.errors import BadCallError
from mjlab.utils.screen import shown
from mjlab.utils.string import counted
from mjlab.utils.tables import WIDTH, json_value, tables_text

if TYPE_CHECKING:
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
    """Print JSON, with all columns and lists in full."""
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
    num_envs = env_cfg.scene.num_envs
    env_cfg.scene.num_envs = 1
    # Tasks that require a GPU are described without one.
    env_cfg.sim.engine = "auto"
    env = ManagerBasedRlEnv(env_cfg, device="cpu")
    try:
        return TaskDescription(task, cfg, num_envs, env)
    finally:
        env.close()


class TaskDescription:
    """Tables of a task.

    Args:
        task: Name of the task.
        cfg: Flags with profile and purpose.
        num_envs: Number of environments in the config.
        env: Environment of the task with any number of environments.
    """

    def __init__(
        self, task: str, cfg: DescribeConfig, num_envs: int, env: ManagerBasedRlEnv
    ) -> None:
        self.task = task
        observations, *others = env.tables()
        self.tables = [observations, unmeasured_table(env), *others]
        self._facts = {
            "task": task,
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
        """Return sizes and times, and the rows of each table, as JSON values."""
        return json_value(self._facts) | {table.name: table.records() for table in self.tables}

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
