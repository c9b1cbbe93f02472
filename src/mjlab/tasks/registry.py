"""Tasks by name.

A task is registered with its configs, or, so that listing tasks costs nothing, with the name of
the functions that make them. Tasks come from the folders of `mjlab.tasks` and from installed
packages that declare an entry point in the group `mjlab.tasks`; they are discovered when the
registry is first asked.
"""

from __future__ import annotations

import copy
import difflib
import functools
import importlib
import inspect
import logging
import pkgutil
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.compat import older_names
from mjlab.utils.errors import MjlabError, UnknownNameError

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnvCfg
    from mjlab.rl.config import RslRlBaseRunnerCfg
    from mjlab.rl.learners import Learner

    Profile = Callable[[Any, Any], RslRlBaseRunnerCfg | None]


# MERGED mjlab.tasks.registry: What a task adds to the command line, and how it gets what it needs before it is built.
#
# A task that needs something (a recorded motion, say) is registered with a dataclass, `options=`, whose
# fields become flags of `train`, `play`, `evaluate` and `profile-env` for this task. The scripts know
# nothing of what is in it: they call `prepare` before they build the environment.


@dataclass(frozen=True)
class PolicyOrigin:
    """Where the policy comes from that is to act, as far as there is one."""

    task: str
    """Name of the task."""
    checkpoint: Path | None = None
    """Its checkpoint, in the folder of its run; also the one that training goes on from."""
    wandb_run_path: str | None = None
    """The Weights & Biases run that the checkpoint was fetched from, as entity/project/run."""


@dataclass
class TaskOptions:
    """Base of the options of a task: a dataclass with a default for each field."""

    def prepare(self, env_cfg: Any, origin: PolicyOrigin) -> None:
        """Edit the environment's config in place, fetching what it needs.

        Called once, before the environment is built; by every process where there are several.

        Args:
            env_cfg: The config, with all flags applied.
            origin: Whose policy is to act.

        Raises:
            ValueError: what is needed is not there; the message says what to do.
        """

    def runner_kwargs(self) -> dict[str, Any]:
        """Return further keyword arguments of the task's runner."""
        return {}


logger = logging.getLogger(__name__)
ENTRY_POINT_GROUP = "mjlab.tasks"

# Modules that every 1.x release brought along, and that are an extra here.
_COMPAT_MODULES = frozenset({"torchrunx", "mediapy", "moviepy"})


class UnknownTaskError(UnknownNameError):
    """Raised for a task name that is not registered; the message lists the nearest ones."""


class UnknownProfileError(MjlabError, ValueError):
    """Raised for a profile that a task does not have; the message lists those it has."""


class TaskImportError(MjlabError, RuntimeError):
    """Raised for a task whose config, runner or profile, given by name, cannot be imported."""


@dataclass(frozen=True)
class _Task:
    env_cfg: Any
    play_env_cfg: Any
    rl_cfg: Any
    runner_cls: Any
    profiles: dict[str, Any]
    options: Any
    source: str | None


_tasks: dict[str, _Task] = {}
_discovered = False


def register_mjlab_task(
    task_id: str,
    env_cfg: ManagerBasedRlEnvCfg | Callable[..., ManagerBasedRlEnvCfg] | str,
    play_env_cfg: ManagerBasedRlEnvCfg | Callable[..., ManagerBasedRlEnvCfg] | str | None = None,
    rl_cfg: RslRlBaseRunnerCfg | Callable[[], RslRlBaseRunnerCfg] | str | None = None,
    runner_cls: type | str | None = None,
    profiles: Mapping[str, Profile | str] | None = None,
    options: type[TaskOptions] | str | None = None,
) -> None:
    """Register a task under `task_id`.

    Args:
        task_id: the name, unique, such as `Mjlab-Cartpole-Swingup`.
        env_cfg: the config to train with: a config, a function that makes it, or the function's
            name as `module:function`, which is imported when the task is first used.
        play_env_cfg: the config to play with, likewise. None calls the function of `env_cfg`,
            with `play=True` if it takes that, or reuses its config.
        rl_cfg: the config of the learner, likewise.
        runner_cls: the runner class or its name as `module:Class`; None takes the default.
        profiles: named settings for other circumstances, such as `cpu` for learning on a few
            cores: for each name a function `(env_cfg, rl_cfg)`, or its name as
            `module:function`, that edits copies of the task's configs in place. It may return
            another learner's config in place of `rl_cfg`, such as `with_learner(rl_cfg, "sac")`
            of `mjlab.rl.learners`. Flags of the command line come after it and win. It may not
            change `rl_cfg.experiment_name`, by which runs of the task are found.
        options: a dataclass of further command-line flags, which also gets what the task needs
            before it is built (see `mjlab.tasks.registry`), or its name as `module:Class`.

    Raises:
        ValueError: the name is taken, `rl_cfg` is missing, or a profile's name is no single word.
    """
    if task_id in _tasks:
        raise ValueError(f"A task named {task_id!r} is registered already; choose another name.")
    if rl_cfg is None:
        raise ValueError(f"Task {task_id!r} needs an rl_cfg (an RslRlOnPolicyRunnerCfg).")
    for profile in profiles or {}:
        if not profile.replace("-", "_").isidentifier() or profile == "None":
            raise ValueError(
                f"Task {task_id!r} has a profile named {profile!r}; a name is one word of letters, "
                "digits, '-' and '_', such as 'cpu', and not 'None'."
            )
    source = sys._getframe(1).f_globals.get("__file__")
    _tasks[task_id] = _Task(
        env_cfg, play_env_cfg, rl_cfg, runner_cls, dict(profiles or {}), options, source
    )


def list_tasks() -> list[str]:
    """Return the names of all tasks, sorted."""
    _discover()
    return sorted(_tasks)


def list_profiles(task_name: str) -> list[str]:
    """Return the names of a task's profiles, sorted; raises UnknownTaskError for no such task."""
    return sorted(_find(task_name).profiles)


def load_env_cfg(
    task_name: str, play: bool = False, profile: str | None = None
) -> ManagerBasedRlEnvCfg:
    """Return a copy of the environment config of a task, to train or to `play` with.

    `profile` names one of the task's profiles, which is applied to it; None applies none.

    Raises:
        UnknownTaskError: no such task.
        UnknownProfileError: the task has no such profile.
        TaskImportError: the config's function is given by name and cannot be imported.
    """
    if profile is not None:
        return _with_profile(task_name, profile, play)[0]
    task = _find(task_name)
    if not play:
        return _made(task_name, task.env_cfg)
    if task.play_env_cfg is not None:
        return _made(task_name, task.play_env_cfg)
    return _made(task_name, task.env_cfg, play=True)


def load_rl_cfg(
    task_name: str, profile: str | None = None, learner: Learner | None = None
) -> RslRlBaseRunnerCfg:
    """Return a copy of the learner's config of a task.

    Args:
        task_name: Name of the task.
        profile: One of the task's profiles, which is applied to it; None applies none.
        learner: `ppo`, `sac` or `distillation`; None takes what the task, or the profile, chooses.
            If the profile replaces the task's own config, and that is of `learner`, it is taken, with
            what the profile says of the task. Otherwise it is made by `mjlab.rl.learners.with_learner`.

    Raises:
        UnknownTaskError, UnknownProfileError, TaskImportError: see `load_env_cfg`.
        ValueError: the learner is unknown, or cannot have the observations that the task's has.
    """
    from mjlab.rl.learners import for_task_of, learner_of, with_learner

    if profile is None:
        cfg = given = _made(task_name, _find(task_name).rl_cfg)
    else:
        _, cfg, given = _with_profile(task_name, profile, play=False)
    if learner is None or learner_of(cfg) == learner:
        return cfg
    if learner_of(given) == learner:
        return for_task_of(given, cfg)
    return with_learner(cfg, learner)


def _with_profile(
    task_name: str, profile: str, play: bool
) -> tuple[ManagerBasedRlEnvCfg, RslRlBaseRunnerCfg, RslRlBaseRunnerCfg]:
    """Return copies of both configs of a task as `profile` makes them.

    The third is the learner's config that the profile was given, which it may have replaced.
    """
    from mjlab.rl.config import RslRlBaseRunnerCfg

    edit = require_profile(task_name, profile)
    if isinstance(edit, str):
        edit = _imported(task_name, edit)
    env_cfg, given = load_env_cfg(task_name, play), load_rl_cfg(task_name)
    experiment = given.experiment_name
    returned = edit(env_cfg, given)
    rl_cfg = given if returned is None else returned
    named = f"The profile {profile!r} of task {task_name!r}"
    if not isinstance(rl_cfg, RslRlBaseRunnerCfg):
        raise ValueError(
            f"{named}: expected None or an RslRlBaseRunnerCfg to be returned, got a "
            f"{type(rl_cfg).__name__}; edit the two configs that it is given."
        )
    if rl_cfg.experiment_name != experiment:
        raise ValueError(
            f"{named} sets experiment_name to {rl_cfg.experiment_name!r}; it has to stay "
            f"{experiment!r}, because that is where runs of the task are looked for."
        )
    # A profile may return a module's constant.
    return env_cfg, rl_cfg if rl_cfg is given else copy.deepcopy(rl_cfg), given


def require_profile(task_name: str, profile: str) -> Profile | str:
    """Return what a profile was registered with.

    Raises:
        UnknownTaskError: no such task.
        UnknownProfileError: no such profile; the message lists the task's.
    """
    profiles = _find(task_name).profiles
    if profile in profiles:
        return profiles[profile]
    there = f"its profiles are: {', '.join(sorted(profiles))}" if profiles else "it has none"
    raise UnknownProfileError(
        f"Task {task_name!r} has no profile {profile!r}; {there}. Without --profile the task's "
        "own settings are used."
    )


def load_runner_cls(task_name: str) -> type | None:
    """Return the runner class of a task, or None for the default one; raises likewise."""
    runner_cls = _find(task_name).runner_cls
    return _imported(task_name, runner_cls) if isinstance(runner_cls, str) else runner_cls


def load_options_cls(task_name: str) -> type[TaskOptions] | None:
    """Return the class of a task's own options, or None if it has none; raises likewise."""
    options = _find(task_name).options
    return _imported(task_name, options) if isinstance(options, str) else options


def task_source(task_name: str) -> str | None:
    """Return the file that registered a task; None if that was no file. Raises UnknownTaskError."""
    return _find(task_name).source


def require_task(task_name: str) -> None:
    """Raise UnknownTaskError, listing the nearest names, unless the task is registered."""
    _find(task_name)


def _find(task_name: str) -> _Task:
    _discover()
    if task_name not in _tasks:
        near = difflib.get_close_matches(task_name, _tasks, n=3, cutoff=0.4)
        hint = f" Did you mean {' or '.join(near)}?" if near else ""
        raise UnknownTaskError(
            f"Unknown task {task_name!r}.{hint} `list-envs` shows all {len(_tasks)} tasks."
        )
    return _tasks[task_name]


def _made(task_name: str, source: Any, **kwargs: Any) -> Any:
    """Return a fresh config from a config, a function, or a function's name."""
    if isinstance(source, str):
        source = _imported(task_name, source)
    if callable(source):
        taken = inspect.signature(source).parameters
        kwargs = {name: value for name, value in kwargs.items() if name in taken}
    # What a function returns is copied too, because it may be put together from module constants.
    return copy.deepcopy(source(**kwargs) if callable(source) else source)


def _imported(task_name: str, name: str) -> Any:
    """Return what `module:attribute` names; raise TaskImportError if that fails."""
    module, _, attribute = name.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    # The module is not ours, and may fail in any way there is.
    except (Exception, SystemExit) as error:
        raise TaskImportError(
            f"Task {task_name!r} cannot be used, because importing {name!r}, which it was "
            f"registered with, failed: {type(error).__name__}: {error}{_missing_extra(error)}"
        ) from error


def _discover() -> None:
    """Import, once, whatever registers tasks. What fails is reported and skipped."""
    global _discovered
    if _discovered:
        return
    _discovered = True
    import mjlab.tasks

    for module in pkgutil.iter_modules(mjlab.tasks.__path__, "mjlab.tasks."):
        if module.ispkg:
            load = functools.partial(importlib.import_module, module.name)
            _register_all(f"the package {module.name!r}", load)
    for entry_point in entry_points(group=ENTRY_POINT_GROUP):
        source = f"the package behind entry point {entry_point.name!r} ({entry_point.value})"
        _register_all(source, entry_point.load)


def _register_all(source: str, load: Callable[[], object]) -> None:
    """Call `load`, which registers tasks: all those of `source`, or none if it fails."""
    before = dict(_tasks)
    try:
        load()
    # A broken package must not take the others down with it, not even one that exits.
    except (Exception, SystemExit) as error:
        # What it registered before it failed may need what it would have done after.
        _tasks.clear()
        _tasks.update(before)
        logger.error(
            "Tasks of %s are skipped, because it fails to import:\n%s%s",
            source,
            traceback.format_exc().rstrip(),
            _missing_extra(error),
        )


def _missing_extra(error: BaseException) -> str:
    """Return the sentence that names the extra, if `error` comes from one of its modules missing."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, ModuleNotFoundError) and cause.name is not None:
            module = cause.name.partition(".")[0]
            # An installed package may lack the submodule: moviepy 2 has no `moviepy.editor`.
            if module in _COMPAT_MODULES and sys.modules.get(module) is None:
                return (
                    f"\n{module} comes with the extra mjlab[compat]: require that in place of "
                    "mjlab, or run `uv sync --extra compat` in the checkout."
                )
        cause = cause.__cause__ or cause.__context__
    return ""


__getattr__ = older_names(__name__)
