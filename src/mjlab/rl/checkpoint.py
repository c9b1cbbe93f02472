"""Checkpoint files: written whole or not at all, and loaded without running what is in them.

A checkpoint holds plain data only, which `torch.load(weights_only=True)` reads: tensors, numbers,
strings, None, and dicts, lists, tuples and sets of those. Beside what the algorithm saves it has
the number of iterations and `training_state`: what exact resume needs beyond the networks, which
are environments, generators and clocks.
"""

from __future__ import annotations

import contextlib
import copy
import errno
import io
import logging
import math
import os
import pickle
import re
import tempfile
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDict

from mjlab.rl.learners import Learner
from mjlab.utils.errors import MjlabError
from mjlab.utils.os import replacing
from mjlab.utils.random import rng_state, set_rng_state

if TYPE_CHECKING:
    from rsl_rl.env import VecEnv

logger = logging.getLogger(__name__)

VERSION = 1
"""Format of `training_state`."""

# Only in checkpoints of SAC.
_SAC_KEY = "sac_state_dict"
# The entries whose type is known, whoever wrote the file: a dict, or a number of iterations.
_DICT_ENTRIES = (
    "model_state_dict", "actor_state_dict", "critic_state_dict", "student_state_dict",
    "teacher_state_dict", "optimizer_state_dict", "rnd_state_dict", "rnd_optimizer_state_dict",
    "infos", "training_state",
)  # fmt: skip
_COUNT_ENTRIES = {"iter": -1, "iterations_finished": 0, "last_evaluated": 0}
# Entries of learning, beside the networks.
_LEARNING_ENTRIES = ("optimizer_state_dict", "rnd_optimizer_state_dict", _SAC_KEY)

# Of older layouts: names of the standard deviation, and prefixes of actor and critic in one state dict.
_STD_NAMES = {
    "std": "distribution.std_param",
    "log_std": "distribution.log_std_param",
}
_SINGLE_MODEL_PREFIXES = {
    "actor.": ("actor_state_dict", "mlp."),
    "actor_obs_normalizer.": ("actor_state_dict", "obs_normalizer."),
    "critic.": ("critic_state_dict", "mlp."),
    "critic_obs_normalizer.": ("critic_state_dict", "obs_normalizer."),
}

# Plain data are exactly these: subclasses (enums, named tuples, numpy's float64) are pickled as calls
# of their class, which loading with `weights_only=True` refuses.
_ATOMS = (
    type(None), bool, int, float, complex, str, bytes,
    torch.Tensor, torch.nn.Parameter, torch.Size, torch.dtype, torch.device,
)  # fmt: skip
_DICTS = (dict, OrderedDict)
_SEQUENCES = (list, tuple, set)


class CheckpointError(MjlabError, RuntimeError):
    """A checkpoint could not be written, read or used; the message says what to do."""


class RunFolderError(MjlabError, OSError):
    """A run folder cannot be written to."""


# Files.


def save_checkpoint(data: Mapping[str, Any], path: str | os.PathLike[str]) -> None:
    """Write `data` (tensors, numbers, strings, and dicts and lists of those) to `path`.

    The file appears whole or not at all: everything goes to a temporary file in the same folder,
    which is flushed to the disk and then renamed. Whatever was at `path` stays until then, and
    nothing is left behind on failure. Numbers of numpy are written as Python's.

    Raises:
        CheckpointError: the disk is full, the folder is read-only, and the like; or `data` holds
            something that `load_checkpoint` would refuse, which the message names.
    """
    path = Path(path)
    try:
        data = as_plain_data(dict(data))
    except TypeError as error:
        raise CheckpointError(
            f"The checkpoint {str(path)!r} was not written, because it could not be loaded again: "
            f"{error}. A checkpoint may hold tensors, numbers, strings, None, and dicts, lists and "
            "tuples of those; convert this entry, or leave it out."
        ) from error
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path, flush=True) as file:
            # Serialized in memory first, because torch's zip writer turns a failing `write` of the
            # file below it into a RuntimeError that hides the reason.
            buffer = io.BytesIO()
            torch.save(data, buffer)
            file.write(buffer.getbuffer())
        # The rename itself is on the disk only once the folder is. Not every system can open one.
        with contextlib.suppress(OSError):
            folder = os.open(path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
    except OSError as error:
        is_full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        reason = "" if is_full else f" ({error.strerror or error})"
        kept = latest_checkpoint(path.parent)
        raise CheckpointError(
            ("The disk is full: the" if is_full else "The")
            + f" checkpoint {str(path)!r} could not be written{reason}."
            + (f" The last checkpoint, {str(kept)!r}, is intact." if kept is not None else "")
            + (" Make room and resume with --agent.resume True." if is_full else "")
        ) from error


def load_checkpoint(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return what `save_checkpoint` (or rsl_rl) wrote to `path`, with all tensors on the CPU.

    Only data is read: a file whose pickle would run code is refused. Checksums are compared, so that
    not a bit of what is returned has changed on the disk (files of torch before 1.6 have none).

    Raises:
        CheckpointError: the file is missing, truncated, not a checkpoint, or hostile.
    """
    path = Path(path)
    if not path.is_file():
        folder = path if path.is_dir() else path.parent
        found = sorted(other.name for other in folder.glob("*.pt"))
        raise CheckpointError(
            f"Checkpoint {str(path)!r}: expected a file, found {'a folder' if path == folder else 'none'}. "
            f"Available in {str(folder)!r}: {found}."
        )
    try:
        with warnings.catch_warnings():
            # About pickle protocols, which say nothing to a user.
            warnings.simplefilter("ignore", UserWarning)
            # torch does not look whether the content of an archive is what was written.
            if zipfile.is_zipfile(path):
                with zipfile.ZipFile(path) as archive:
                    if (damaged := archive.testzip()) is not None:
                        raise zipfile.BadZipFile(f"the checksum of {damaged} is wrong")
            data = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        called = re.search(r"(?:GLOBAL|class|function) ([\w.]+)", str(error))
        reason, hint = "it is not a file of torch, or is corrupt", ""
        if called is not None:
            reason = f"it wants to call {called[1]!r}, and a checkpoint may hold data only"
            hint = (
                " Do not use this file unless you trust where it comes from; weights can be saved "
                "again with torch.save({...: state_dict()})."
            )
        raise CheckpointError(
            f"The checkpoint {str(path)!r} was refused: {reason}. Nothing in it was run.{hint}"
        ) from error
    except Exception as error:
        # Damaged bytes make the reader fail in any way there is.
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:160]
        raise CheckpointError(
            f"The checkpoint {str(path)!r} is truncated or corrupt "
            f"({path.stat().st_size} bytes; {reason}). Use an earlier one."
        ) from error
    if not isinstance(data, dict):
        raise CheckpointError(
            f"{str(path)!r} is not a checkpoint of a training run: it holds a "
            f"{type(data).__name__}, not a dict."
        )
    return data


def latest_checkpoint(folder: Path) -> Path | None:
    """Return the `model_<number>.pt` with the highest number in `folder`, or None."""
    if not folder.is_dir():
        return None
    numbered = {
        int(match.group(1)): path
        for path in folder.iterdir()
        if (match := re.fullmatch(r"model_(\d+)\.pt", path.name))
    }
    return numbered[max(numbered)] if numbered else None


def learner_of_checkpoint(path: str | os.PathLike[str]) -> Learner:
    """Return the learner that wrote a checkpoint.

    Raises:
        CheckpointError: see `load_checkpoint`.
    """
    checkpoint = load_checkpoint(path)
    if "student_state_dict" in checkpoint:
        return "distillation"
    return "sac" if _SAC_KEY in checkpoint else "ppo"


def ensure_writable_folder(folder: str | os.PathLike[str]) -> Path:
    """Make `folder` if it is missing, and write a file into it to see that this works.

    Raises:
        RunFolderError: the folder cannot be made or written to.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".write-test-") as file:
            file.write(b"x")
            file.flush()
    except OSError as error:
        raise RunFolderError(
            f"The run folder {str(folder)!r} cannot be written to ({error.strerror or error}). "
            "Choose another place with --log-root, or change its permissions."
        ) from error
    return folder


class RunRescue:
    """Saves a run whose folder disappears, or in which an iteration fails.

    A context around the iterations. Set `learned` to what the last finished iteration left, as
    checkpoint entries: an error in the block saves that, unless there is a checkpoint of it.
    """

    learned: dict[str, Any] | None = None
    """Entries of a checkpoint that resumes in new episodes; None: there is nothing to save."""

    def __init__(self, folder: str | os.PathLike[str] | None) -> None:
        """Take the run folder; None: this process writes no files."""
        self._folder = None if folder is None else os.fspath(folder)
        self._descriptor: int | None = None

    def __enter__(self) -> RunRescue:
        if self._folder is not None:
            # Kept open, so that another folder of its name can be told from it. Windows opens no
            # folders, and deletes none in which a file is open.
            with contextlib.suppress(PermissionError):
                self._descriptor = os.open(self._folder, os.O_RDONLY)
        return self

    def check_folder(self, save: Callable[[str], None], name: str) -> None:
        """Save the run beside its folder, by `save(path)`, if that is gone.

        Raises:
            RunFolderError: the folder is gone; the message says where `name` is.
        """
        if self._descriptor is None or self._folder is None:
            return
        # The next writer, such as TensorBoard, creates another folder of that name.
        with contextlib.suppress(OSError):
            if os.path.samestat(os.fstat(self._descriptor), os.stat(self._folder)):
                return
        path = os.path.join(f"{os.path.normpath(self._folder)}_rescued", name)
        save(path)
        raise RunFolderError(
            f"The run folder {self._folder!r} is no longer there: it was deleted or moved while the run "
            f"was training. The run was saved to {path!r}, from which it resumes."
        )

    def __exit__(self, kind: Any, error: BaseException | None, traceback: Any) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None
        if self.learned is None or self._folder is None:
            return
        if not isinstance(error, Exception) or isinstance(error, (CheckpointError, RunFolderError)):
            return
        path = os.path.join(self._folder, f"model_{self.learned['iter']}.pt")
        # Weights that are NaN may be why training failed, and could not be loaded again.
        if os.path.exists(path) or not_finite(self.learned):
            return
        try:
            save_checkpoint(self.learned, path)
        except CheckpointError as failure:
            # What failed first is what the user has to know.
            logger.warning("%s", failure)
            return
        logger.warning(
            "Training failed in iteration %d. Weights and optimizer of before are in %s; a run that is "
            "resumed from there starts in new episodes.",
            self.learned["iterations_finished"] + 1, path,
        )  # fmt: skip


# Networks and optimizer.


def load_algorithm(
    algorithm: Any,
    checkpoint: dict[str, Any],
    load_cfg: dict[str, bool] | None,
    strict: bool,
    path: str,
) -> bool:
    """Let rsl_rl load its parts of a migrated `checkpoint`, read from `path`.

    Args:
        algorithm: rsl_rl's, or one with its methods.
        checkpoint: What `migrate` returned.
        load_cfg: Which parts to load; None loads all.
        strict: Whether every parameter has to fit.
        path: The file, for messages.

    Returns:
        Whether the count of iterations is to be loaded.

    Raises:
        CheckpointError: a part is missing, does not fit, or is not finite; nothing was changed then.
    """
    for name in ("actor", "critic", "student", "teacher"):
        model = getattr(algorithm, f"_raw_{name}", None)
        if strict and model is not None and (load_cfg is None or load_cfg.get(name)):
            check_fits(model, checkpoint.get(f"{name}_state_dict"), name=name, path=path)
    if load_cfg is None or load_cfg.get("optimizer"):
        saved = checkpoint.get("optimizer_state_dict")
        check_optimizer_fits(algorithm.optimizer, saved, path=path)
        broken = not_finite({name: checkpoint.get(name) for name in _LEARNING_ENTRIES})
        if broken:
            raise CheckpointError(
                f"The checkpoint {path!r} holds values that are NaN or infinite: {', '.join(broken)}. "
                "Use an earlier one; nothing was changed."
            )
    # rsl_rl loads one part after the other, and what fits only in part is half loaded then.
    before = copy.deepcopy(algorithm.save())
    try:
        return algorithm.load(checkpoint, load_cfg, strict)
    except (KeyError, ValueError, RuntimeError, TypeError, AttributeError) as error:
        algorithm.load(before, None, True)
        raise CheckpointError(
            f"The checkpoint {path!r} does not fit this algorithm: {error}. To use its "
            "policy only, load it with load_cfg={'actor': True}."
        ) from error


def check_fits(
    model: torch.nn.Module, saved: Mapping[str, Any] | None, *, name: str, path: str
) -> None:
    """Check that the state dict `saved` fits `model`.

    Raises:
        CheckpointError: parameters are missing, unknown, of another shape, or NaN or infinite; all are
            listed.
    """
    if saved is None:
        raise CheckpointError(
            f"The checkpoint {path!r} holds no {name} weights; use one that the same learner wrote."
        )
    own = model.state_dict()
    expected = {key: tuple(value.shape) for key, value in own.items()}
    found = {key: tuple(value.shape) for key, value in saved.items() if hasattr(value, "shape")}
    if expected == found:
        # What a network is built with, such as a mask of minus infinity, may be in its checkpoint.
        broken = [
            key
            for key, value in own.items()
            if value.isfinite().all() and not saved[key].isfinite().all()
        ]
        if broken:
            raise CheckpointError(
                f"The checkpoint {path!r} holds {name} weights that are NaN or infinite: "
                f"{', '.join(broken)}. Use an earlier one; nothing was changed."
            )
        return
    lines = [
        f"  {key}: expected {expected.get(key, 'nothing')}, found {found.get(key, 'nothing')}"
        for key in sorted(expected.keys() | found.keys())
        if expected.get(key) != found.get(key)
    ]
    raise CheckpointError(
        f"The checkpoint {path!r} is of another network: its {name} does not fit this task's "
        f"{name} config.\n" + "\n".join(lines) + "\nUse a checkpoint of this task, or make "
        f"the network (--agent.{name}.) and the observations what they were when it was trained."
    )


def check_optimizer_fits(
    optimizer: torch.optim.Optimizer, saved: Mapping[str, Any] | None, *, path: str
) -> None:
    """Check that the state `saved` is of as many parameters of the same shapes.

    torch itself compares numbers of parameters only, and would fail at the next update.

    Raises:
        CheckpointError: it is not.
    """
    try:
        fits = saved is not None and _optimizer_fits(optimizer, saved)
    except (KeyError, TypeError, AttributeError):
        fits = False
    if not fits:
        raise CheckpointError(
            f"The checkpoint {path!r} holds no optimizer state for these networks. To use its "
            "policy only, load it with load_cfg={'actor': True}; nothing was changed."
        )


def _optimizer_fits(optimizer: torch.optim.Optimizer, saved: Mapping[str, Any]) -> bool:
    groups = saved["param_groups"]
    if len(groups) != len(optimizer.param_groups):
        return False
    for group, own in zip(groups, optimizer.param_groups, strict=True):
        if len(group["params"]) != len(own["params"]) or not isinstance(group["lr"], float):
            return False
        # Switches of torch's optimizers; another release may have others.
        switches = [name for name, value in own.items() if isinstance(value, bool)]
        if not all(isinstance(group.get(name, False), bool) for name in switches):
            return False
        for number, parameter in zip(group["params"], own["params"], strict=True):
            state = saved["state"].get(number)
            if state is not None and not state:
                # torch would begin with new moments, without a word.
                return False
            for value in (state or {}).values():
                is_moment = isinstance(value, torch.Tensor) and value.dim() > 0
                if is_moment and value.shape != parameter.shape:
                    return False
    return True


def not_finite(value: Any, name: str = "") -> list[str]:
    """Return the names of tensors within `value` that hold NaN, and of learning rates not finite."""
    if isinstance(value, torch.Tensor):
        return [name] if bool(value.isnan().any()) else []
    if isinstance(value, float):
        return [name] if name.endswith(".lr") and not math.isfinite(value) else []
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, (list, tuple)):
        items = enumerate(value)
    else:
        return []
    prefix = f"{name}." if name else ""
    return [found for key, item in items for found in not_finite(item, f"{prefix}{key}")]


# Exact resume.


def capture_training_state(
    env: VecEnv, algorithm: Any, logger_state: dict[str, Any], observations: TensorDict
) -> dict[str, Any]:
    """Return the state between two iterations, `observations` being the ones to act on next."""
    unwrapped: Any = getattr(env, "unwrapped", env)
    hidden = [model.get_hidden_state() for model in _models(algorithm)]
    state: dict[str, Any] = {
        "version": VERSION,
        "num_envs": env.num_envs,
        "rng": rng_state(),
        "observations": {key: value.clone() for key, value in _flat(observations).items()},
        "logger": logger_state,
        "hidden_states": [list(one) if isinstance(one, tuple) else one for one in hidden],
        "rnd": None,
    }
    if (rnd := getattr(algorithm, "rnd", None)) is not None:
        average = _reward_average(rnd)
        state["rnd"] = {
            "update_counter": rnd.update_counter,
            "discounted_average": None if average is None else average.avg,
        }
    if hasattr(unwrapped, "state_dict"):
        state["env"] = unwrapped.state_dict()
    return state


def restore_training_state(
    state: dict[str, Any],
    env: VecEnv,
    algorithm: Any,
    load_logger: Callable[[dict[str, Any]], None],
    device: str | torch.device,
) -> TensorDict:
    """Restore what `capture_training_state` returned, and return the observations to act on next.

    Args:
        state: What was captured.
        env: The environments.
        algorithm: rsl_rl's, or one with its methods, on `device`.
        load_logger: Takes the state of the logger.
        device: Device of the networks.

    Raises:
        ValueError: the state is of other environments; nothing was changed then.
        CheckpointError: the state is malformed.
    """
    try:
        observations = _matching_observations(state, env)
        unwrapped: Any = getattr(env, "unwrapped", env)
        if "env" in state and hasattr(unwrapped, "load_state_dict"):
            # Tensors that the rollout made can only be written to in this mode.
            with torch.inference_mode():
                unwrapped.load_state_dict(_to(state["env"], env.device))
        load_logger(state["logger"])
        for model, hidden in zip(_models(algorithm), state["hidden_states"], strict=True):
            if hidden is not None:
                hidden = _to(hidden, device)
                model.reset(hidden_state=tuple(hidden) if isinstance(hidden, list) else hidden)
        if hasattr(algorithm, "last_hidden_states"):
            # Of rsl_rl's distillation, which begins an update with those before the iteration.
            algorithm.last_hidden_states = (algorithm.student.get_hidden_state(), None)
        rnd = getattr(algorithm, "rnd", None)
        if rnd is not None and state["rnd"] is not None:
            rnd.update_counter = state["rnd"]["update_counter"]
            if (average := _reward_average(rnd)) is not None:
                average.avg = _to(state["rnd"]["discounted_average"], device)
        observations = observations.to(device)
        # Last, because restoring may have drawn random numbers.
        set_rng_state(state["rng"])
        return observations
    except torch.OutOfMemoryError:
        raise
    except (KeyError, TypeError, AttributeError, IndexError, RuntimeError) as error:
        raise CheckpointError(
            f"The checkpoint's training_state is malformed ({type(error).__name__}: {error}). Use an "
            "earlier checkpoint, or load only its networks with load_cfg={'actor': True, 'critic': True}."
        ) from error


def _matching_observations(state: dict[str, Any], env: VecEnv) -> TensorDict:
    """Return the observations of `state`; raise ValueError if it is of other environments."""
    if state.get("version") != VERSION:
        raise ValueError(f"It was saved in format {state.get('version')}, not {VERSION}.")
    if state["num_envs"] != env.num_envs:
        raise ValueError(
            f"It is of {state['num_envs']} environments and this run has {env.num_envs}; give "
            f"--num-envs {state['num_envs']}."
        )
    observations = TensorDict({}, batch_size=[env.num_envs])
    for key, value in state["observations"].items():
        observations.set(tuple(key.split("\n")), value)
    found, expected = (
        {key: tuple(value.shape) for key, value in _flat(one).items()}
        for one in (observations, env.get_observations())
    )
    if found != expected:
        raise ValueError(f"Its observations are {found}, and this run's {expected}.")
    return observations


def _flat(observations: TensorDict) -> dict[str, torch.Tensor]:
    """Return the tensors by name; names of nested ones are joined by a newline."""
    return {
        "\n".join(key) if isinstance(key, tuple) else key: observations.get(key)
        for key in observations.keys(include_nested=True, leaves_only=True)
    }


def _models(algorithm: Any) -> list[Any]:
    names = ("actor", "critic", "student", "teacher")
    return [getattr(algorithm, name) for name in names if hasattr(algorithm, name)]


def _reward_average(rnd: Any) -> Any:
    """Return the discounted average of the reward normalizer of RND; None without one."""
    return getattr(getattr(rnd, "reward_normalizer", None), "disc_avg", None)


def _to(value: Any, device: Any) -> Any:
    """Move all tensors within dicts and lists to `device`."""
    if isinstance(value, torch.Tensor):
        return value.to(device)
    if isinstance(value, dict):
        return {key: _to(item, device) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_to(item, device) for item in value)
    return value


# Older layouts.


def migrate(checkpoint: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Return `checkpoint`, read from `path`, in today's layout; the argument is not changed.

    Two older layouts are known: one state dict for actor and critic together
    (`model_state_dict`), and an actor whose standard deviation is called `std` or `log_std`.

    Raises:
        CheckpointError: an entry is not of the type that it must have.
    """
    _check_types(checkpoint, path)
    migrated = dict(checkpoint)
    if migrated.get("model_state_dict") is not None:
        parts: dict[str, dict[str, Any]] = {"actor_state_dict": {}, "critic_state_dict": {}}
        for name, value in migrated.pop("model_state_dict").items():
            if name in _STD_NAMES:
                parts["actor_state_dict"][name] = value
            for prefix, (part, today) in _SINGLE_MODEL_PREFIXES.items():
                if name.startswith(prefix):
                    parts[part][today + name.removeprefix(prefix)] = value
        migrated.update(parts)
    if migrated.get("actor_state_dict") is not None:
        migrated["actor_state_dict"] = {
            _STD_NAMES.get(name, name): value
            for name, value in migrated["actor_state_dict"].items()
        }
    return migrated


def _check_types(checkpoint: Mapping[str, Any], path: str) -> None:
    for name in _DICT_ENTRIES:
        value = checkpoint.get(name)
        # None stands for an entry that is not there: rsl_rl writes `infos` so.
        if value is not None and not isinstance(value, dict):
            raise _malformed(path, name, "a dict", value)
        if value is not None and name.endswith("_state_dict"):
            for key in value:
                if not isinstance(key, str):
                    raise _malformed(path, f"a key of {name}", "a string", key)
    for name, least in _COUNT_ENTRIES.items():
        if name in checkpoint and not _is_count(checkpoint[name], least):
            raise _malformed(path, name, f"a whole number from {least} up", checkpoint[name])
    owes = checkpoint.get("owes_evaluation", False)
    if not isinstance(owes, bool):
        raise _malformed(path, "owes_evaluation", "a bool", owes)
    env_state = (checkpoint.get("infos") or {}).get("env_state")
    if env_state is None:
        return
    if not isinstance(env_state, dict):
        raise _malformed(path, "infos.env_state", "a dict", env_state)
    counter = env_state.get("common_step_counter", 0)
    if not _is_count(counter, 0):
        name = "infos.env_state.common_step_counter"
        raise _malformed(path, name, "a whole number from 0 up", counter)


def _is_count(value: Any, least: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def _malformed(path: str, name: str, allowed: str, value: Any) -> CheckpointError:
    shown = repr(value)
    shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
    return CheckpointError(
        f"The checkpoint {path!r} is malformed: {name} must be {allowed} and is {shown} "
        f"({type(value).__name__}). Use another checkpoint; nothing was changed."
    )


# Plain data.


def as_plain_data(value: Any, path: str = "") -> Any:
    """Return `value` with numpy's scalars as Python's; containers without any are returned as is.

    Args:
        value: Tensors, numbers, strings, None, and dicts, lists, tuples and sets of those.
        path: Where in a file `value` is to be, for the message.

    Raises:
        TypeError: something else is in there; the message says where and of which type.
    """
    if isinstance(value, np.generic):
        value = value.item()
    kind = type(value)
    if kind in _ATOMS:
        return value
    if kind in _SEQUENCES:
        items = [as_plain_data(item, f"{path}[{index}]") for index, item in enumerate(value)]
        same = all(one is other for one, other in zip(items, value, strict=True))
        return value if same else kind(items)
    if kind not in _DICTS:
        raise TypeError(f"{path or 'it'} is a {kind.__module__}.{kind.__qualname__}")
    entries = {
        as_plain_data(key, f"a key of {path or 'it'}"): as_plain_data(
            item, f"{path}.{key}" if path else str(key)
        )
        for key, item in value.items()
    }
    if all(
        key is other and entries[key] is value[other]
        for key, other in zip(entries, value, strict=True)
    ):
        return value
    # A copy and not a new dict, because state dicts of modules carry versions as an attribute.
    plain = copy.copy(value)
    plain.clear()
    plain.update(entries)
    return plain
