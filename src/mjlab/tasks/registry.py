"""Task registry.

A task is registered with its configs or with the names of functions that return them; names keep
listing tasks free of heavy imports. Tasks come from the packages of `mjlab.tasks` and from installed
packages with an entry point in the group `mjlab.tasks`. The first query of the registry
discovers them.

A task that needs external data, such as a recorded motion, registers a dataclass as `options`. The
fields of the dataclass become flags of `train`, `play`, `evaluate` and `profile-env` for this task, and
the scripts call its `prepare` before they build the environment.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import importlib
import inspect
import logging
import pkgutil
import sys
import traceback
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points, packages_distributions, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from mjlab.compat import older_names
from mjlab.utils.config_fields import check_fields_exist
from mjlab.utils.errors import MjlabError, UnknownNameError
from mjlab.utils.string import suggest
from mjlab.utils.tracebacks import TASK_PACKAGES, users_lines

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnvCfg
    from mjlab.rl.config import RslRlBaseRunnerCfg
    from mjlab.rl.learners import Learner

    ProfileEdit = Callable[[Any, Any], RslRlBaseRunnerCfg | None]

logger = logging.getLogger(__name__)
# Modules that 1.x releases depend on, and that are an extra here.
_COMPAT_MODULES = frozenset({"torchrunx", "mediapy", "moviepy"})
_tasks: dict[str, _Task] = {}
_discovered = False
_DEFAULT_RL_CFG = "mjlab.rl.config:RslRlOnPolicyRunnerCfg"


def register_mjlab_task(
    task_id: str,
    env_cfg: ManagerBasedRlEnvCfg | Callable[..., ManagerBasedRlEnvCfg] | str,
    play_env_cfg: ManagerBasedRlEnvCfg | Callable[..., ManagerBasedRlEnvCfg] | str | None = None,
    rl_cfg: RslRlBaseRunnerCfg | Callable[[], RslRlBaseRunnerCfg] | str | None = None,
    runner_cls: type | str | None = None,
    profiles: Mapping[str, Profile | ProfileEdit | str] | None = None,
    options: type[TaskOptions] | str | None = None,
) -> None:
    """Register a task under `task_id`.

    Args:
        task_id: Unique name, such as `Mjlab-Cartpole-Swingup`.
        env_cfg: Environment config: a config, a function that returns one, or the name of the function
            as `module:function`. Names are imported on first use. The function is called with
            `play=True` to play, and with `evaluate=True` for evaluations, if it has that parameter.
        play_env_cfg: Play environment config, in the forms of `env_cfg`. None: `env_cfg`.
        rl_cfg: Learner config, in the forms of `env_cfg`. None: the default PPO, with a warning.
        runner_cls: Runner class, or its name as `module:Class`. None: the default runner.
        profiles: Named variants of the configs, such as `cpu` for training on a few cores: a `Profile`,
            the function of a profile that eases nothing, or the name of either as `module:name`.
            Command-line flags override profiles. Profiles must keep `rl_cfg.experiment_name`,
            because runs of the task are found by it.
        options: Dataclass of further command-line flags that also prepares the environment config (see
            `TaskOptions`), or its name as `module:Class`.

    Raises:
        ValueError: the name is taken, or a profile name is not a single word.
    """
    if task_id in _tasks:
        raise ValueError(f"A task named {task_id!r} is registered already; choose another name.")
    if rl_cfg is None:
        rl_cfg = _DEFAULT_RL_CFG
        warnings.warn(
            f"Task {task_id!r} rl_cfg: expected a learner config, got None; {rl_cfg}() is used.",
            UserWarning,
            stacklevel=2,
        )
    for profile in profiles or {}:
        if not profile.replace("-", "_").isidentifier() or profile == "None":
            raise ValueError(
                f"Task {task_id!r} profiles: expected names of letters, digits, '-' and '_', not 'None', "
                f"got {profile!r}; use e.g. 'cpu'."
            )
    _tasks[task_id] = _Task(
        env_cfg, play_env_cfg, rl_cfg, runner_cls, dict(profiles or {}), options
    )


def list_tasks() -> list[str]:
    """Return the names of all tasks, sorted."""
    _discover()
    return sorted(_tasks)


def list_profiles(task_name: str) -> list[str]:
    """Return the names of a task's profiles, sorted. Raises `UnknownTaskError`."""
    return sorted(_find(task_name).profiles)


def load_env_cfg(
    task_name: str, play: bool = False, profile: str | None = None, *, evaluate: bool = False
) -> ManagerBasedRlEnvCfg:
    """Return a copy of the environment config of a task: to train, to `play`, or to `evaluate`.

    `profile` is the name of a task profile to apply, without what eases training if the config is
    not to train. None: no profile.

    Raises:
        UnknownTaskError: unknown task.
        UnknownProfileError: unknown profile.
        TaskImportError: importing the config's function by name failed.
    """
    if profile is not None:
        return _with_profile(task_name, profile, play, evaluate)[0]
    return _registered_env_cfg(task_name, play, evaluate)


def load_rl_cfg(
    task_name: str, profile: str | None = None, learner: Learner | None = None
) -> RslRlBaseRunnerCfg:
    """Return a copy of the learner config of a task, to train.

    Args:
        task_name: Name of the task.
        profile: Name of a task profile to apply, with its easing. None: no profile.
        learner: `ppo`, `sac` or `distillation`. None: the learner of the profile or task. If the
            profile replaces a task config that is of `learner`, the task config is used, with the
            task settings of the profile. Otherwise `mjlab.rl.learners.with_learner` converts the
            config.

    Raises:
        UnknownTaskError, UnknownProfileError, TaskImportError: see `load_env_cfg`.
        ValueError: the learner is unknown, or does not support the networks or observations of the
            task.
    """
    from mjlab.rl.learners import for_task_of, learner_of, with_learner

    if profile is None:
        cfg = task_cfg = _make_cfg(task_name, _find(task_name).rl_cfg)
    else:
        _, cfg, task_cfg = _with_profile(task_name, profile)
    if learner is None or learner_of(cfg) == learner:
        return cfg
    if learner_of(task_cfg) == learner:
        return for_task_of(task_cfg, cfg)
    return with_learner(cfg, learner)


def load_runner_cls(task_name: str) -> type | None:
    """Return the runner class of a task, or None for the default. Raises as `load_env_cfg`."""
    return _resolve(task_name, _find(task_name).runner_cls)


def load_options_cls(task_name: str) -> type[TaskOptions] | None:
    """Return the options class of a task, or None. Raises as `load_env_cfg`."""
    return _resolve(task_name, _find(task_name).options)


def require_profile(task_name: str, profile: str) -> Profile | ProfileEdit | str:
    """Return a profile as registered.

    Raises:
        UnknownTaskError: unknown task.
        UnknownProfileError: unknown profile; the message lists the task's profiles.
    """
    profiles = _find(task_name).profiles
    if profile in profiles:
        return profiles[profile]
    raise UnknownProfileError(
        f"Unknown profile {profile!r} of task {task_name!r}; {suggest(profile, sorted(profiles))} Omit "
        "--profile to use the settings of the task."
    )


def require_task(task_name: str) -> None:
    """Raise `UnknownTaskError`, listing close names, unless the task is registered."""
    _find(task_name)


def task_source(task_name: str) -> str | None:
    """Return a file of the package that registered a task.

    That of an entry point, or for tasks registered otherwise the main script. None: an interactive
    session. Raises `UnknownTaskError`.
    """
    module = sys.modules.get(_find(task_name).package or "__main__")
    return getattr(module, "__file__", None)


def task_package(task_name: str) -> str | None:
    """Return name and version of the package that registered a task; None for mjlab, and for scripts."""
    module = (_find(task_name).package or "").partition(".")[0]
    if module in ("", "mjlab"):
        return None
    names = packages_distributions().get(module)
    return f"{names[0]} {version(names[0])}" if names else module


# Profiles: alternative settings.


@dataclass(frozen=True)
class Profile:
    """Alternative settings of a task: edits of its configs, in place, as functions `(env_cfg, rl_cfg)`.

    Each may return the config of another learner to use instead of `rl_cfg`, such as
    `with_learner(rl_cfg, "sac")` of `mjlab.rl.learners`. A function registered as a profile is its
    `policy`: none of its edits is limited to training.
    """

    policy: ProfileEdit
    """Sets what the policy is: observations, actions, networks, commands such as a clock. Applied in
    training, evaluations, play and on the robot."""
    easing: ProfileEdit | None = None
    """Eases training: physics, contacts, rewards, terminations, curricula. Applied to the training
    environments only, after `policy`. None: training is not eased."""


# Options: task-specific command-line flags.


@dataclass
class TaskOptions:
    """Base class of task options: a dataclass with a default for each field.

    Runs record their options, and are resumed and played with them.
    """

    unrecorded: ClassVar[tuple[str, ...]] = ()
    """Fields that are not recorded, because the run folder holds the data that they select."""
    run_files: ClassVar[tuple[str, ...]] = ()
    """Patterns of the files in a run folder that `prepare` reads, such as "motion/*". A published policy
    has them."""

    def prepare(self, env_cfg: Any, origin: PolicyOrigin) -> None:
        """Edit the environment config in place, and fetch required data.

        Scripts call `prepare` once, before they build the environment; with several processes, once
        in each.

        Args:
            env_cfg: Environment config with all flags applied.
            origin: Origin of the policy.

        Raises:
            ValueError: required data is missing; the message names a remedy.
        """

    def runner_kwargs(self) -> dict[str, Any]:
        """Return extra keyword arguments of the task's runner."""
        return {}


@dataclass(frozen=True)
class PolicyOrigin:
    """Origin of a policy. Fields are None without a trained policy."""

    task: str
    """Name of the task."""
    checkpoint: Path | None = None
    """Checkpoint in the folder of its run, also when training resumes from the checkpoint."""
    wandb_run_path: str | None = None
    """Weights & Biases run of the checkpoint, as entity/project/run."""


# Errors.


class UnknownTaskError(UnknownNameError):
    """Task name that is not registered. The message lists close names."""


class UnknownProfileError(MjlabError, ValueError):
    """Profile that the task does not have. The message lists the task's profiles."""


class TaskImportError(MjlabError, RuntimeError):
    """Task whose config, runner, profile or options cannot be imported by name."""


# Config creation and task discovery.


@dataclass(frozen=True)
class _Task:
    env_cfg: Any
    play_env_cfg: Any
    rl_cfg: Any
    runner_cls: Any
    profiles: dict[str, Any]
    options: Any
    package: str | None = None
    """Module whose import registered the task. None: not imported by `_discover`."""


def _registered_env_cfg(task_name: str, play: bool, evaluate: bool) -> ManagerBasedRlEnvCfg:
    """Return a copy of the environment config of a task, without a profile."""
    task = _find(task_name)
    if play and task.play_env_cfg is not None:
        return _make_cfg(task_name, task.play_env_cfg)
    purpose = {"play": True} if play else {"evaluate": True} if evaluate else {}
    return _make_cfg(task_name, task.env_cfg, **purpose)


def _with_profile(
    task_name: str, profile: str, play: bool = False, evaluate: bool = False
) -> tuple[ManagerBasedRlEnvCfg, RslRlBaseRunnerCfg, RslRlBaseRunnerCfg]:
    """Return copies of both configs of a task with `profile` applied, and the edited task config.

    The third config differs from the second if the profile replaces the task's learner config. Eased
    unless to play or evaluate.
    """
    from mjlab.rl.config import RslRlBaseRunnerCfg

    found = _resolve(task_name, require_profile(task_name, profile))
    edits = found if isinstance(found, Profile) else Profile(policy=found)
    env_cfg = _registered_env_cfg(task_name, play, evaluate)
    rl_cfg = task_cfg = _make_cfg(task_name, _find(task_name).rl_cfg)
    num_envs, experiment = env_cfg.scene.num_envs, task_cfg.experiment_name
    # Copied, because a profile may return a module constant.
    rl_cfg = copy.deepcopy(edits.policy(env_cfg, rl_cfg)) or rl_cfg
    if play or evaluate:
        # A number chosen for learning is unrelated to the number to play.
        env_cfg.scene.num_envs = num_envs
    elif edits.easing is not None:
        rl_cfg = copy.deepcopy(edits.easing(env_cfg, rl_cfg)) or rl_cfg
    owner = f"Profile {profile!r} of task {task_name!r}"
    if not isinstance(rl_cfg, RslRlBaseRunnerCfg):
        raise ValueError(
            f"{owner}: expected None or an RslRlBaseRunnerCfg as return value, got "
            f"{type(rl_cfg).__name__}; edit the two config arguments in place."
        )
    if rl_cfg.experiment_name != experiment:
        raise ValueError(
            f"{owner} experiment_name: expected {experiment!r}, got {rl_cfg.experiment_name!r}; "
            "runs of the task are found by this name."
        )
    for cfg in (env_cfg, rl_cfg):
        check_fields_exist(type(cfg).__name__, cfg)
    return env_cfg, rl_cfg, task_cfg


def _find(task_name: str) -> _Task:
    _discover()
    if task_name not in _tasks:
        raise UnknownTaskError(
            f"Unknown task {task_name!r}; {suggest(task_name, sorted(_tasks))} `uv run mjlab list-envs` lists all "
            f"{len(_tasks)} tasks."
        )
    return _tasks[task_name]


def _make_cfg(task_name: str, source: Any, **kwargs: Any) -> Any:
    """Return a new config from a config, a function, or the name of a function."""
    source = _resolve(task_name, source)
    if callable(source):
        accepted = inspect.signature(source).parameters
        kwargs = {name: value for name, value in kwargs.items() if name in accepted}
    # Return values of functions are copied too, because they may contain module constants.
    cfg = copy.deepcopy(source(**kwargs) if callable(source) else source)
    # Checked here, because command lines build a new config from the fields.
    check_fields_exist(type(cfg).__name__, cfg)
    return cfg


def _resolve(task_name: str, value: Any) -> Any:
    """Return `value`, imported if it is a name `module:attribute`. Raises `TaskImportError`."""
    if not isinstance(value, str):
        return value
    module, _, attribute = value.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    # Modules of other packages may raise any exception.
    except (Exception, SystemExit) as error:
        raise TaskImportError(
            f"Task {task_name!r} cannot be used: importing {value!r} failed: "
            f"{type(error).__name__}: {error}{_missing_extra(error)}"
        ) from error


def _discover() -> None:
    """Import all packages that register tasks, once. Packages that fail are reported and skipped."""
    global _discovered
    if _discovered:
        return
    _discovered = True
    import mjlab.tasks

    for module in pkgutil.iter_modules(mjlab.tasks.__path__, "mjlab.tasks."):
        if module.ispkg:
            load = functools.partial(importlib.import_module, module.name)
            _register_all(f"the package {module.name!r}", module.name, load)
    for entry_point in entry_points(group=TASK_PACKAGES):
        source = f"the package behind entry point {entry_point.name!r} ({entry_point.value})"
        _register_all(source, entry_point.module, entry_point.load)


def _register_all(source: str, module: str, load: Callable[[], object]) -> None:
    """Register the tasks of `module` by calling `load`; register none of them if it raises."""
    before = dict(_tasks)
    try:
        load()
        for name, task in list(_tasks.items()):
            if name not in before or _names_config_in(task, module):
                _tasks[name] = dataclasses.replace(task, package=module)
    # A broken package, even one that exits, must not affect the others.
    except (Exception, SystemExit) as error:
        # Roll back: tasks registered before the error may depend on code that did not run.
        _tasks.clear()
        _tasks.update(before)
        logger.error(
            "Skipping the tasks of %s: import failed:\n%s%s%s",
            source,
            users_lines(error),
            "".join(traceback.format_exception_only(error)).rstrip(),
            _missing_extra(error),
        )


def _names_config_in(task: _Task, module: str) -> bool:
    """Return True for a task of `module` that a script registered by importing it before discovery."""
    return isinstance(task.env_cfg, str) and task.env_cfg.startswith(f"{module}.")


def _missing_extra(error: BaseException) -> str:
    """Return a hint at the extra if one of its modules is missing, the error or its cause, else ""."""
    missing = error if isinstance(error, ModuleNotFoundError) else error.__cause__
    name = missing.name if isinstance(missing, ModuleNotFoundError) else None
    module = (name or "").partition(".")[0]
    # An installed package may lack the submodule: moviepy 2 has no `moviepy.editor`.
    if module not in _COMPAT_MODULES or sys.modules.get(module) is not None:
        return ""
    return (
        f"\n{module} comes with the extra mjlab[compat]: require mjlab[compat] instead of mjlab, or run "
        "`uv sync --extra compat` in the checkout."
    )


__getattr__ = older_names(__name__)
