"""Runs: what a folder of training says about itself, and the choice among several.

A folder holds `run.json` (task, profile, learner, settings, evaluations, end), `params/*.yaml` (the
resolved configs), event files and checkpoints. Folders of other tools and of releases 1.x may lack
`run.json`; their settings are read from `params`.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from mjlab.rl.learners import Learner
from mjlab.runs.checkpoint import Checkpoint
from mjlab.runs.settings import (
    Difference,
    Settings,
    apply_settings,
    differences,
    read_yaml,
    warn_unreadable,
)
from mjlab.runs.source import local_policy
from mjlab.tasks.registry import list_profiles, load_env_cfg, load_rl_cfg
from mjlab.utils.errors import UserError
from mjlab.utils.logging import print_notice
from mjlab.utils.os import (
    WANDB_CACHE,
    checkpoint_number,
    checkpoints_in,
    is_locked,
    regular_file,
    to_plain,
)

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnvCfg
    from mjlab.rl.config import RslRlBaseRunnerCfg

Purpose = Literal["train", "evaluate", "play"]
State = Literal["running", "finished", "solved", "interrupted", "failed"]

INFO_FILE = "run.json"
"""File of the metadata of a run."""
RUNNING_FILE = ".running"
"""File that the training process locks while it runs."""
POLICY_FILE = "policy.onnx"
"""Exported policy in a folder that was published."""
TIME_FORMAT = "%Y-%m-%d_%H-%M-%S"
"""Format of the start time in the name of a folder."""
DONE = ("solved", "finished")
"""States of completed training."""

# Characters of a value in a message.
_LONGEST = 100
# First lines of a file in `git/`, also as rsl_rl writes it.
_COMMIT = re.compile(r"--- git commit ---\s+([0-9a-f]{7,64})\b")
_TIME = re.compile(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d")


@dataclass(frozen=True, kw_only=True)
class RunCfg:
    """Configs of a run for a purpose."""

    env: ManagerBasedRlEnvCfg
    """Environment."""
    agent: RslRlBaseRunnerCfg
    """Learner."""
    left_out: dict[str, str]
    """Settings of the run that do not fit the configs, and the reasons, by path."""


class Run:
    """Training run in a folder. Files are read when first needed; an instance does not follow a
    training that goes on."""

    def __init__(
        self, folder: Path | str, task: str | None = None, learner: str | None = None
    ) -> None:
        """Set the folder.

        Args:
            folder: Folder of the run.
            task: Task to use the run in. None: the recorded one.
            learner: Learner of a run that does not record it.
        """
        self.folder = Path(folder)
        """Folder of the run."""
        self._task = task
        self._learner = learner

    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r})"

    # Metadata.

    def as_registered(self) -> Run:
        """Return the run without its settings: its task, profile and learner as registered today."""
        run = Run(self.folder, self._task, self._learner)
        run.settings = {}
        return run

    @property
    def exists(self) -> bool:
        """True if training created the folder, which may also just store policies."""
        return (self.folder / INFO_FILE).is_file() or (self.folder / "params").is_dir()

    @cached_property
    def info(self) -> dict[str, Any]:
        """Metadata of the run (`run.json`); empty if missing or unreadable."""
        try:
            info = json.loads(regular_file(self.folder / INFO_FILE).read_text(encoding="utf-8"))
            if not isinstance(info, dict):
                raise ValueError(f"expected entries, got {type(info).__name__}")
            return info
        except (FileNotFoundError, NotADirectoryError):
            return {}
        except (OSError, ValueError, RecursionError) as error:
            warn_unreadable(self.folder / INFO_FILE, error)
            return {}

    @cached_property
    def params(self) -> dict[Literal["env", "agent"], dict[str, Any]]:
        """Resolved configs as plain data (`params/*.yaml`); empty if missing or unreadable."""
        folder = self.folder / "params"
        agent = read_yaml(folder / "agent.yaml")
        if isinstance(evaluation := agent.get("evaluation"), dict):
            agent["evaluation"] = _with_success(evaluation)
        return {"env": read_yaml(folder / "env.yaml"), "agent": agent}

    @property
    def task(self) -> str | None:
        """Task to use the run in; None if not given and not recorded."""
        return self._task or self._text("task")

    @property
    def learner(self) -> str | None:
        """Learner; None if not recorded."""
        learner = self._text("learner")
        return learner if learner in get_args(Learner) else self._learner

    @property
    def profile(self) -> str | None:
        """Profile of the task; None if the run had none, or one that the task no longer has."""
        profile = self._text("profile")
        is_known = self.task is None or profile in list_profiles(self.task)
        return profile if is_known else None

    def _text(self, name: str) -> str | None:
        value = self.info.get(name)
        return value if isinstance(value, str) else None

    def is_of(self, task: str | None, learner: str | None) -> bool:
        """Return True unless the run records another task or learner. None: any."""
        return task in (None, self._text("task") or task) and learner in (
            None,
            self.learner or learner,
        )

    @property
    def num_envs(self) -> int | None:
        """Number of environments per process; None if not recorded."""
        scene = self.params["env"].get("scene")
        count = scene.get("num_envs") if isinstance(scene, dict) else None
        return count if isinstance(count, int) and count >= 1 else None

    @property
    def seed(self) -> int | None:
        """Seed; None if not recorded."""
        seed = self.params["agent"].get("seed")
        return seed if isinstance(seed, int) and seed >= 0 else None

    @property
    def commit(self) -> str | None:
        """Commit of the task's repository at the start (`git/`); None if not recorded.

        None also for several repositories: the folder does not tell whose the task is.
        """
        found = _COMMIT.match(self._git)
        return self._text("commit") or (found[1] if found else None)

    @property
    def has_changed_commit(self) -> bool:
        """True if the files of the task's repository differed from `commit` at the start."""
        changes = self._git.partition("--- git diff ---")[2]
        return self.info.get("has_changed_commit") is True or bool(changes.strip())

    @cached_property
    def _git(self) -> str:
        """State of the task's repository at the start, as rsl_rl writes it; empty if unknown."""
        files = list((self.folder / "git").glob("*.diff"))
        if len(files) == 1:
            with contextlib.suppress(OSError):
                return files[0].read_text(encoding="utf-8", errors="replace")
        return ""

    @property
    def started(self) -> datetime | None:
        """Start of the run, as recorded or as in the name of the folder."""
        with contextlib.suppress(ValueError):
            # Comparable with times in names.
            return datetime.fromisoformat(self._text("started") or "").replace(tzinfo=None)
        named = _TIME.match(self.folder.name)
        with contextlib.suppress(ValueError):
            return datetime.strptime(named.group(), TIME_FORMAT) if named else None
        return None

    @property
    def state(self) -> State:
        """State. A run that was killed is interrupted."""
        ended = self.info.get("ended")
        if ended is None and is_locked(self.folder / RUNNING_FILE):
            return "running"
        if ended in (*DONE, "failed"):
            return ended
        # A signal in the last iteration.
        total, done = self.params["agent"].get("max_iterations"), self.info.get("iterations")
        is_done = isinstance(total, int) and isinstance(done, int) and done >= total
        return "finished" if is_done else "interrupted"

    @cached_property
    def evaluations(self) -> list[dict[str, Any]]:
        """Evaluations during training, in order: `iteration`, `mean_return`, `solved`, ...

        Of runs that do not record them, the values in the event files.
        """
        recorded = self.info.get("evaluations")
        if isinstance(recorded, list):
            numbers = ("iteration", "mean_return")
            return [
                entry
                for entry in recorded
                if isinstance(entry, dict)
                and all(isinstance(entry.get(n), int | float) for n in numbers)
            ]
        from mjlab.rl.plot import read_all_scalars

        found: dict[int, dict[str, Any]] = {}
        with contextlib.suppress(ValueError):
            for tag, (iterations, values) in read_all_scalars(self.folder).items():
                group, _, name = tag.partition("/")
                for i, value in (
                    zip(iterations, values, strict=True) if group == "Evaluation" else ()
                ):
                    found.setdefault(int(i) + 1, {})[name] = float(value)
        return [{"iteration": i, **found[i]} for i in sorted(found)]

    # Checkpoints.

    @property
    def checkpoints(self) -> list[Checkpoint]:
        """Checkpoints `model_<number>.pt`, in the order of their numbers."""
        return [Checkpoint(path) for path in checkpoints_in(self.folder)]

    @property
    def newest(self) -> Checkpoint | None:
        """Last checkpoint; None without checkpoints."""
        checkpoints = self.checkpoints
        return checkpoints[-1] if checkpoints else None

    @property
    def joined(self) -> list[Run]:
        """Runs that continue one another, from the first session to this one.

        Raises:
            UserError: folder of an earlier session not found.
        """
        sessions = [Run(self.folder.resolve(), self._task)]
        while (resumed := sessions[0].info.get("resumed")) is not None:
            # `/` also handles an absolute `resumed`.
            folder = (sessions[0].folder.parent / str(resumed)).parent
            if not folder.is_dir() or folder in [run.folder for run in sessions]:
                raise UserError(
                    f"{sessions[0].folder / INFO_FILE} resumed: expected the folder of an earlier "
                    f"session, got {str(resumed)!r}; put that folder back."
                )
            sessions.insert(0, Run(folder, self._task))
        return sessions

    @property
    def is_evaluated(self) -> bool:
        """True if this session or one that it continues records an evaluation."""
        with contextlib.suppress(UserError):
            return any(run.info.get("evaluations") for run in self.joined)
        return bool(self.info.get("evaluations"))

    def describe(self) -> str:
        """Return `14:03, solved, 960`: start, state, mean return of the last evaluation."""
        started = self.started
        day = "%H:%M" if started and started.date() == datetime.now().date() else "%Y-%m-%d %H:%M"
        parts = [self.folder.name if started is None else f"{started:{day}}", self.state]
        if self.evaluations and "mean_return" in self.evaluations[-1]:
            parts.append(f"{self.evaluations[-1]['mean_return']:.4g}")
        return ", ".join(parts)

    # Configs.

    @cached_property
    def settings(self) -> Settings:
        """Settings that differ from the registered task, by path; those of Python callers included.

        Read from `params` if not recorded.
        """
        recorded = self.info.get("settings")
        if isinstance(recorded, dict):
            return _with_success(recorded, "agent.evaluation.")
        if self.task is None:
            return {}
        env, agent = self._registered("train")
        changes = [
            *differences(env, self.params["env"], "env"),
            *differences(agent, self.params["agent"], "agent"),
        ]
        return {one.path: to_plain(one.recorded) for one in changes}

    def recorded(self, path: str) -> Any:
        """Return the value of a setting by its path, else that in the resolved configs; None if absent."""
        # First, because names of keys in paths may hold dots.
        if path in self.settings:
            return self.settings[path]
        value: Any = self.params
        for name in path.split("."):
            value = value.get(name) if isinstance(value, dict) else None
        return value

    def cfg(self, purpose: Purpose = "train", **choices: Any) -> RunCfg:
        """Return the configs of the run: those registered today, with the settings of the run.

        Number of environments, seed, engine, logger and the like are those of the task.

        Args:
            purpose: Purpose of the environments; see `registered_env_cfg`.
            **choices: `profile` or `learner` other than those of the run.

        Raises:
            UserError: the task is unknown.
        """
        env, agent = self._registered(purpose, **choices)
        env, left_out = apply_settings(env, self.settings, "env")
        agent, of_agent = apply_settings(agent, self.settings, "agent")
        return RunCfg(env=env, agent=agent, left_out=left_out | of_agent)

    def _registered(self, purpose: Purpose, **choices: Any) -> tuple[Any, Any]:
        if self.task is None:
            raise UserError(
                f"{self.folder}: expected a run of a known task, got none; name the task."
            )
        choices = {"profile": self.profile, "learner": self.learner, **choices}
        env = registered_env_cfg(self.task, choices["profile"], purpose)
        return env, load_rl_cfg(self.task, **choices)

    @property
    def changes(self) -> list[Difference]:
        """Changes of the code since the run: configs with its settings today, and as recorded."""
        if not isinstance(self.info.get("settings"), dict):
            return []
        cfg, prepared = self.cfg("train"), self.info.get("prepared") or []
        found = [
            *differences(cfg.env, self.params["env"], "env"),
            *differences(cfg.agent, self.params["agent"], "agent"),
        ]
        return [one for one in found if one.path not in cfg.left_out and one.path not in prepared]

    def notes(self, purpose: Purpose, cfg: RunCfg, profile: str | None) -> list[str]:
        """Return lines on the configs that a command uses for this run.

        Differences from the registered task, settings of the run that were left out, and changes of
        the code since the run.

        Args:
            purpose: Purpose of the environments.
            cfg: Configs, with the flags of the command; differences of the learner matter to train.
            profile: Profile of the task.
        """
        env, agent = self._registered(purpose, profile=profile)
        found = [*differences(cfg.env, to_plain(env), "env")]
        if purpose == "train":
            found += differences(cfg.agent, to_plain(agent), "agent")
        lines = [
            f"{one.path}: {_short(one.now)} (registered: {_short(one.recorded)})" for one in found
        ]
        if (unknown := self._text("profile")) != self.profile:
            lines.append(f"profile: {unknown!r} of the run left out: unknown to {self.task}")
        lines += [
            f"{_short(path)}: {_short(self.settings[path])} of the run left out: {_short(reason)}"
            for path, reason in cfg.left_out.items()
        ]
        now = {one.path: one.now for one in found}
        lines += [
            f"{one.path}: {_short(one.now)} today, {_short(one.recorded)} when the run was trained"
            for one in self.changes
            if one.path not in now
        ]
        return lines

    def check_terms(self, env: ManagerBasedRlEnvCfg, networks: Iterable[str]) -> None:
        """Check that observation and action terms of `env` are those of the run, in the same order.

        Networks of equal sizes would otherwise read other terms than those they were trained with.

        Args:
            env: Config of environments to run networks of this run in.
            networks: Networks (`actor`, `critic`, ...) to run.

        Raises:
            UserError: names or order differ.
        """
        groups = self.params["agent"].get("obs_groups")
        lists = [groups.get(network) for network in networks] if isinstance(groups, dict) else ()
        read = [group for names in lists if isinstance(names, list) for group in names]
        self._check_terms(env, zip(read, read, strict=True))

    def check_teacher(self, env: ManagerBasedRlEnvCfg, groups: Iterable[str]) -> None:
        """Check that the actor of the run, maybe of another task, can act on observation `groups` of `env`.

        Raises:
            UserError: names or order of observation or action terms differ.
        """
        read = self.recorded("agent.obs_groups.actor")
        recorded = read if isinstance(read, list) else ("actor",)
        self._check_terms(env, zip(recorded, groups, strict=False))

    def _check_terms(self, env: ManagerBasedRlEnvCfg, groups: Iterable[tuple[Any, Any]]) -> None:
        """Compare the action terms, and those of observation `groups`: recorded name, name in `env`."""
        from mjlab.rl.checkpoint import other_terms

        # Files edited by hand may hold anything.
        names = {then: now for then, now in groups if isinstance(then, str)}
        # Weights & Biases does not keep the order of what it stores.
        if self.folder.parent.name == WANDB_CACHE:
            return
        recorded, actions = (self.params["env"].get(name) for name in ("observations", "actions"))
        pairs = {"actions": (actions, env.actions)}
        for group, then in recorded.items() if isinstance(recorded, dict) else ():
            now = env.observations.get(names.get(group, ""))
            if now is not None and isinstance(then, dict):
                pairs[f"observations.{group}"] = then.get("terms"), now.terms
        known = {name: pair for name, pair in pairs.items() if isinstance(pair[0], dict)}
        trained, used = ({name: _names(pair[i]) for name, pair in known.items()} for i in (0, 1))
        if reason := other_terms(trained, used):
            raise UserError(f"The policy of {self.folder} {reason}")


def _names(terms: Any) -> dict[str, str]:
    """Return the names of terms that are not switched off, in order, as `other_terms` takes them."""
    return {name: "" for name, cfg in terms.items() if cfg is not None}


def _with_success(entries: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return `entries` with `success` for the three fields that it replaced in evaluations."""
    entries = dict(entries)
    for name in ("success_func", "success_is_survival", "success_return"):
        if value := entries.get(prefix + name):
            del entries[prefix + name]
            entries.setdefault(f"{prefix}success", "survival" if value is True else value)
    return entries


def _short(value: Any) -> str:
    """Return a value in one line. Terms with all their parameters are long, and lists of configs
    of other lengths begin alike."""
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return f"{len(value)} entries"
    text = str(value)
    text = text if text.isprintable() else repr(text)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def registered_env_cfg(task: str, profile: str | None, purpose: Purpose) -> ManagerBasedRlEnvCfg:
    """Return the environment config of `task` for a policy trained under `profile`.

    Args:
        task: Name of the task.
        profile: Profile, or None.
        purpose: `train` for the training config; `evaluate` for that of evaluations; `play` for the
            play config of the task.
    """
    return load_env_cfg(task, purpose == "play", profile, evaluate=purpose == "evaluate")


# Choice among runs.


def runs_in(
    experiment: Path,
    task: str | None = None,
    learner: str | None = None,
    run_name: str | None = None,
) -> list[Run]:
    """Return the runs of an experiment, the last started first.

    Runs that do not record their task or learner match any.

    Args:
        experiment: Folder of the runs.
        task: Task of the runs. None: any.
        learner: Learner of the runs. None: any.
        run_name: Name given to the runs by `--agent.run-name`. None: any.
    """
    if not experiment.is_dir():
        return []
    named = re.compile(".*" if run_name is None else rf".*_{re.escape(run_name)}(-\d+)?")
    folders = (path for path in experiment.iterdir() if path.is_dir())
    runs = [Run(path, task) for path in folders if named.fullmatch(path.name)]
    runs = [run for run in runs if run.is_of(task, learner)]
    return sorted(
        runs, key=lambda run: (run.started or datetime.min, run.folder.name), reverse=True
    )


def newest_run(runs: Iterable[Run]) -> Run | None:
    """Return the run to play or evaluate, of those with checkpoints: the first one that is running,
    else evaluated, else finished, else the first. `runs` are in the order of `runs_in`.
    """
    candidates = [run for run in runs if run.newest is not None]
    rules = (
        lambda run: run.state == "running",
        # Runs of earlier versions do not record evaluations.
        lambda run: run.is_evaluated or run.state == "solved",
        lambda run: run.state in DONE,
        lambda run: True,
    )
    return next((run for rule in rules for run in candidates if rule(run)), None)


def resolve_checkpoint(path: Path, task: str) -> Checkpoint:
    """Return the checkpoint at `path`, or the last one of a run folder, else its exported policy.

    The path may also be a ZIP archive or `hf:NAME/REPO`; see `local_policy`. It may omit the run folder:
    `logs/rsl_rl/cartpole/model_500.pt` refers to that file of the newest run of `task`, or to the last
    checkpoint of that run if it was solved or finished before iteration 500.

    Raises:
        UserError: file not found; the message lists the available checkpoints. Or see `local_policy`.
    """
    path = local_policy(path)
    if path.is_file():
        return Checkpoint(path)
    folder, number = Run(path, task), checkpoint_number(path.name)
    if folder.newest is not None:
        return folder.newest
    if (exported := path / POLICY_FILE).is_file():
        return Checkpoint(exported)
    newest = newest_run(runs_in(path.parent, task)) if number is not None else None
    last = newest.newest if newest is not None else None
    if newest is not None and last is not None and number is not None:
        if (sibling := newest.folder / path.name).is_file():
            return Checkpoint(sibling)
        if newest.state in DONE and number > (last.number or 0):
            print_notice(
                f"The newest run was {newest.state} before {path.name}. Its last checkpoint: {last}"
            )
            return last
    runs = [Run(path.parent), *runs_in(path.parent)[:1]]
    available = [str(checkpoint) for run in runs for checkpoint in run.checkpoints[-3:]]
    hint = (
        f"Available: {', '.join(available)}."
        if available
        else f"Use `uv run mjlab train {task}` first."
    )
    raise UserError(f"Checkpoint {path} not found. {hint}")
