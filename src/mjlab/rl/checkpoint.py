"""Checkpoint files: atomic writes, and loading without code execution.

A checkpoint holds plain data only, readable by `torch.load(weights_only=True)`: tensors, numbers,
strings, None, and dicts, lists, tuples and sets of those. Besides the algorithm's entries it has
the number of iterations and `training_state`: the state of environments, random number generators
and timers that exact resume needs.
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
import zlib
from collections import OrderedDict
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from operator import index
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mjlab.envs.env_state import curricula_in
from mjlab.utils.errors import MjlabError, UserError
from mjlab.utils.logging import first_line
from mjlab.utils.os import check_archive, checkpoint_number, checkpoints_in, files_in, replacing
from mjlab.utils.random import rng_state, set_rng_state
from mjlab.utils.torch import to_device

if TYPE_CHECKING:
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict

logger = logging.getLogger(__name__)

VERSION = 1
"""Format of `training_state`."""

_CHECKSUM = "checksum"
_NETWORKS = ("actor", "critic", "student", "teacher")

# Legacy layouts: names of the standard deviation, and prefixes of actor and critic in one state dict.
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

# Plain data are exactly these types: subclasses (enums, named tuples, numpy's float64) are pickled as
# calls of their class, and `weights_only=True` rejects those.
_ATOMS = (
    type(None), bool, int, float, complex, str, bytes,
    torch.Tensor, torch.nn.Parameter, torch.Size, torch.dtype, torch.device,
)  # fmt: skip
_DICTS = (dict, OrderedDict)
_SEQUENCES = (list, tuple, set)


class CheckpointError(MjlabError, RuntimeError):
    """Checkpoint that cannot be written, read or used; the message says what to do."""

    def __init__(self, message: str, reason: str = "") -> None:
        """Store `reason`, the part of the message that names neither the file nor what to do."""
        super().__init__(message)
        self.reason = reason or message


class RunFolderError(MjlabError, OSError):
    """Run folder that is not writable."""


# Files.


def save_checkpoint(data: Mapping[str, Any], path: str | os.PathLike[str]) -> None:
    """Write `data` (tensors, numbers, strings, and dicts and lists of those) to `path`.

    The write is atomic: data goes to a temporary file in the same folder; the file is flushed to disk
    and then renamed. An existing file at `path` stays until then, and a failure leaves no files
    behind. NumPy scalars are written as Python's. A checksum of the contents is added.

    Raises:
        CheckpointError: the disk is full, the folder is read-only, and the like; or `data` holds
            an entry that `load_checkpoint` would reject. The message names it.
    """
    path = Path(path)
    try:
        plain = as_plain_data(dict(data))
    except TypeError as error:
        raise CheckpointError(
            f"Checkpoint {str(path)!r}: expected tensors, numbers, strings, None, and dicts, lists and "
            f"tuples of those, got an entry that cannot be loaded: {error}; convert or remove this "
            "entry. The file was not written."
        ) from error
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path, flush=True) as file:
            # Serialize in memory first: torch's zip writer turns a failing `write` of the
            # underlying file into a RuntimeError that hides the reason.
            buffer = io.BytesIO()
            torch.save({**plain, _CHECKSUM: _checksum(plain)}, buffer)
            file.write(buffer.getbuffer())
        # The rename is on disk only once the folder is flushed. Not every system can open folders.
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
            + (" Free disk space and resume with --agent.resume True." if is_full else "")
        ) from error


def load_checkpoint(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Load a checkpoint of `save_checkpoint` or rsl_rl, with all tensors on the CPU.

    Only data is read: a file whose pickle would run code is rejected. Checksums are compared, so that
    corruption on disk is detected (files of torch before 1.6 have no checksums). A file that was edited
    since is a warning.

    Raises:
        CheckpointError: the file is missing, truncated, hostile or not a checkpoint.
    """
    data, is_intact = read_checkpoint(path)
    if not is_intact:
        cure = _other_checkpoint(path)
        logger.warning(
            "Checkpoint %r is not as it was written (another checksum). If you did not edit it, use %s.",
            str(path), cure,
        )  # fmt: skip
    return data


def read_checkpoint(path: str | os.PathLike[str]) -> tuple[dict[str, Any], bool]:
    """Return the contents of a checkpoint, and False if they are not those written.

    See `load_checkpoint`. Contents without checksum, of rsl_rl and earlier versions, count as intact.
    """
    path = Path(path)
    if not path.is_file():
        folder = path if path.is_dir() else path.parent
        found = sorted(other.name for other in files_in(folder, "*.pt"))
        raise CheckpointError(
            f"Checkpoint {str(path)!r}: expected a file, found {'a folder' if path == folder else 'none'}. "
            f"Available in {str(folder)!r}: {found}."
        )
    try:
        with warnings.catch_warnings():
            # The warnings are about pickle protocols and of no use to a user.
            warnings.simplefilter("ignore", UserWarning)
            # torch does not verify the checksums of an archive.
            if zipfile.is_zipfile(path):
                check_archive(path)
            data = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(data, dict):
            raise ValueError(f"expected a dict, got a {type(data).__name__}")
        written = data.pop(_CHECKSUM, None)
        is_intact = written is None or (type(written) is int and written == _checksum(data))
        return data, is_intact
    except pickle.UnpicklingError as error:
        called = re.search(r"(?:GLOBAL|class|function) ([\w.]+)", str(error))
        reason, hint = "not a file of torch, or corrupt", ""
        if called is not None:
            reason = f"expected plain data, got a call of {called[1]!r}"
            hint = (
                " Do not use this file unless you trust its source; save weights as plain data with "
                "torch.save({...: state_dict()})."
            )
        raise CheckpointError(
            f"Checkpoint {str(path)!r} was rejected: {reason}. No code in it was run.{hint}", reason
        ) from error
    except Exception as error:
        # Damaged bytes make the reader raise arbitrary exceptions.
        raise unusable(
            path, f"truncated or corrupt ({path.stat().st_size} bytes; {first_line(error)})"
        ) from error


def _checksum(data: Any) -> int:
    """Return the CRC-32 of nested plain data."""
    total = 0
    for name, value in _leaves(data):
        if isinstance(value, torch.Tensor):
            name = f"{name} {value.dtype} {tuple(value.shape)}"
            values = value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy()
        else:
            values = repr(value).encode()
        total = zlib.crc32(values, zlib.crc32(name.encode(), total))
    return total


def unusable(path: str | os.PathLike[str], reason: str) -> CheckpointError:
    """Return the error for a checkpoint that is damaged: file, reason, and the checkpoint to use instead."""
    cure = _other_checkpoint(path)
    return CheckpointError(
        f"Checkpoint {str(path)!r}: {reason}; use {cure}. Nothing was changed.", reason
    )


def _other_checkpoint(path: str | os.PathLike[str]) -> str:
    earlier = latest_checkpoint(Path(path).parent, before=Path(path).name)
    return "another checkpoint" if earlier is None else f"an earlier checkpoint, {str(earlier)!r}"


def latest_checkpoint(folder: Path, before: str = "") -> Path | None:
    """Return the checkpoint with the highest number in `folder`, or None.

    `before` is the name of a checkpoint; only those with a lower number count.
    """
    limit = checkpoint_number(before)
    paths = checkpoints_in(folder)
    paths = [p for p in paths if limit is None or (checkpoint_number(p.name) or 0) < limit]
    return paths[-1] if paths else None


def ensure_writable_folder(folder: str | os.PathLike[str]) -> Path:
    """Create `folder` if it is missing, and check that it is writable.

    Raises:
        RunFolderError: the folder cannot be created or is not writable.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".write-test-") as file:
            file.write(b"x")
            file.flush()
    except OSError as error:
        raise RunFolderError(
            f"Run folder {str(folder)!r} cannot be written to ({error.strerror or error}); choose "
            "another folder with --log-root, or change its permissions."
        ) from error
    return folder


class RunRescue:
    """Context manager that saves a run if its folder disappears or an iteration fails.

    Set `learned` to the checkpoint entries of the last finished iteration: an error in the block
    saves them, unless that checkpoint exists already.
    """

    learned: dict[str, Any] | None = None
    """Entries of a checkpoint, saved without its episodes. None: nothing to save."""

    def __init__(self, folder: str | os.PathLike[str] | None) -> None:
        """Store the run folder. None: this process writes no files."""
        self._folder = None if folder is None else os.fspath(folder)
        self._descriptor: int | None = None

    def __enter__(self) -> RunRescue:
        if self._folder is not None:
            # An open descriptor distinguishes the folder from a new one of the same name. Windows
            # cannot open folders, and does not delete folders with open files.
            with contextlib.suppress(PermissionError):
                self._descriptor = os.open(self._folder, os.O_RDONLY)
        return self

    def check_folder(self, save: Callable[[str], None], name: str) -> None:
        """Save the run next to its folder, by `save(path)`, if the folder was deleted or moved.

        Raises:
            RunFolderError: the folder was deleted or moved; the message has the new path of `name`.
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
            f"Run folder {self._folder!r} was deleted or moved during training. The run was saved to "
            f"{path!r}; resume from there."
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
        is_new = not os.path.exists(path)
        # In the same episodes, the failure may come again.
        state = lasting_state(self.learned["training_state"])
        try:
            if is_new:
                save_checkpoint({**self.learned, "training_state": state}, path)
        except CheckpointError as failure:
            # The first error is the one that the user needs to see.
            logger.warning("%s", failure)
            return
        logger.warning(
            "Training failed in iteration %d. Weights and optimizer of the previous iteration are in %s%s.",
            self.learned["iterations_finished"] + 1, path,
            "; a run resumed from there starts in new episodes" if is_new else "",
        )  # fmt: skip


# Networks and optimizer.


def load_algorithm(
    algorithm: Any,
    checkpoint: dict[str, Any],
    load_cfg: dict[str, bool] | None,
    strict: bool,
    path: str,
) -> bool:
    """Load the entries of a migrated `checkpoint` into rsl_rl's `algorithm`.

    Args:
        algorithm: An rsl_rl algorithm, or one with its methods.
        checkpoint: Result of `migrate`.
        load_cfg: Parts to load; None: all.
        strict: Require every parameter to fit.
        path: Checkpoint file, for messages.

    An optimizer of another kind than the saved one keeps its own state, with a warning.

    Returns:
        True if the iteration count is to be loaded.

    Raises:
        CheckpointError: a part is missing or does not fit. Nothing was changed.
    """
    optimizer, changed_from, part = algorithm.optimizer, None, "state"
    # rsl_rl loads one part after the other: an error leaves the algorithm partly loaded.
    before = copied(algorithm.save())
    try:
        parts = [f"{name}_state_dict" for name in (*_NETWORKS, "optimizer")]
        if bad := not_finite({key: checkpoint[key] for key in parts if key in checkpoint}):
            raise ValueError(f"{bad[0]} is NaN or infinite")
        if (saved := checkpoint.get("optimizer_state_dict")) is not None:
            changed_from = _other_kind(optimizer, saved)
        if changed_from is not None:
            checkpoint = {**checkpoint, "optimizer_state_dict": optimizer.state_dict()}
        # Loaded once more below; here, an error is known to be of this network.
        for name in _NETWORKS:
            network = getattr(algorithm, f"_raw_{name}", None)
            if network is not None and (load_cfg is None or load_cfg.get(name)):
                part = name
                network.load_state_dict(checkpoint[f"{name}_state_dict"], strict=strict)
        part = "state"
        loads_iteration = algorithm.load(checkpoint, load_cfg, strict)
    except Exception as error:
        algorithm.load(before, None, True)
        if isinstance(error, (torch.OutOfMemoryError, MemoryError)):
            raise
        text = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise CheckpointError(
            f"Checkpoint {path!r}: its {part} does not fit this run: {text}\nUse a checkpoint of this task "
            "and learner, or the network config and the observations of the training run. Nothing was "
            "changed."
        ) from error
    if hasattr(algorithm, "student"):
        # rsl_rl's distillation loads the rate of its optimizer only.
        algorithm.learning_rate = optimizer.param_groups[0]["lr"]
    if changed_from is not None:
        logger.warning(
            "The optimizer starts fresh, with learning rate %g: the checkpoint has the state of %s, this "
            "run uses %s.",
            algorithm.learning_rate, changed_from, _kind_of(optimizer.param_groups[0]),
        )  # fmt: skip
    return loads_iteration


def override_algorithm(algorithm: Any, name: str, value: Any) -> None:
    """Set a restored setting of rsl_rl's `algorithm`; settings it was built with act already.

    Args:
        algorithm: An rsl_rl algorithm, or one with its methods, after `load_algorithm`.
        name: Dotted name of the setting, without "algorithm".
        value: Value of the setting.
    """
    optimizer = algorithm.optimizer
    if name.startswith("rnd_cfg."):
        rnd = getattr(algorithm, "rnd", None)
        optimizer, name = getattr(rnd, "optimizer", None), name.removeprefix("rnd_cfg.")
    elif name == "learning_rate":
        # The adaptive schedule continues from here.
        algorithm.learning_rate = float(value)
    if optimizer is None:
        return
    # Names of torch: weight_decay, betas, momentum, ...
    name = "lr" if name == "learning_rate" else name
    for group in optimizer.param_groups:
        if name in group and name != "params":
            group[name] = tuple(value) if isinstance(value, list) else value


def set_deviation(model: torch.nn.Module, name: str, value: float) -> None:
    """Set the standard deviation of a restored policy that does not depend on its observations.

    Args:
        model: A model of rsl_rl.
        name: Name of the model, for the message.
        value: Standard deviation.

    Raises:
        UserError: the standard deviation depends on observations.
    """
    distribution = getattr(model, "distribution", None)
    for attribute, scaled in (("std_param", value), ("log_std_param", math.log(value))):
        if (parameter := getattr(distribution, attribute, None)) is not None:
            with torch.no_grad():
                parameter.fill_(scaled)
            return
    raise UserError(
        f"--agent.{name}.distribution-cfg.init-std: expected that of the resumed run, because its "
        f"network has learned the standard deviation, got {value}; leave it out, or train a new run."
    )


def not_finite(entries: Mapping[str, Any]) -> list[str]:
    """Return the names of the tensors in nested `entries` with values that are NaN or infinite."""
    tensors = {
        name: value
        for name, value in _leaves(entries)
        if isinstance(value, torch.Tensor) and value.is_floating_point()
    }
    if not tensors:
        return []
    # One synchronization with the device of the networks.
    device = next(iter(tensors.values())).device
    finite = torch.stack([value.isfinite().all().to(device) for value in tensors.values()]).tolist()
    return [name for name, is_finite in zip(tensors, finite, strict=True) if not is_finite]


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values in nested dicts and sequences, with their positions."""
    if not isinstance(value, (dict, list, tuple, set)):
        yield name, value
        return
    if isinstance(value, set):
        # The order of texts differs between processes.
        value = sorted(value, key=repr)
    for key, item in value.items() if isinstance(value, dict) else enumerate(value):
        yield from _leaves(item, f"{name}.{key}" if name else str(key))


# A setting that no other kind of torch's optimizers has.
_OPTIMIZERS = {"betas": "adam", "alpha": "rmsprop", "dampening": "sgd"}
# Setting of adam and adamw, in torch since 2.7.
_IS_ADAMW = "decoupled_weight_decay"


def _kind_of(group: Mapping[str, Any]) -> str | None:
    """Return the name of the optimizer with the settings `group`; None: unknown."""
    kinds = [kind for name, kind in _OPTIMIZERS.items() if name in group]
    if len(kinds) != 1:
        return None
    return "adamw" if group.get(_IS_ADAMW) else kinds[0]


def _other_kind(optimizer: torch.optim.Optimizer, saved: Mapping[str, Any]) -> str | None:
    """Return the name of the optimizer of the state `saved` if it is another one; else None."""
    group, own = saved["param_groups"][0], optimizer.param_groups[0]
    found, expected = _kind_of(group), _kind_of(own)
    if found is None or expected is None or found == expected:
        return None
    is_unknown = _IS_ADAMW not in group or _IS_ADAMW not in own
    return None if is_unknown and "betas" in group and "betas" in own else found


# Terms of observations and actions.


def term_shapes(env: Any, obs_groups: Mapping[str, Iterable[str]]) -> dict[str, Any]:
    """Return names and shapes of the terms that each network reads, and of `actions`, in their order.

    Empty for environments without managers.

    Args:
        env: Environments.
        obs_groups: Observation groups of each network.
    """
    env = getattr(env, "unwrapped", env)
    observations = getattr(env, "observation_manager", None)
    actions = getattr(env, "action_manager", None)
    if observations is None or actions is None:
        return {}
    names, shapes = observations.active_terms, observations.group_obs_term_dim
    read = {
        network: {
            f"{group}.{name}": list(shape)
            for group in groups
            for name, shape in zip(names[group], shapes[group], strict=True)
        }
        for network, groups in obs_groups.items()
    }
    sizes = {name: [actions.get_term(name).action_dim] for name in actions.active_terms}
    return {**read, "actions": sizes}


def check_terms(saved: Any, now: Mapping[str, Any], networks: Iterable[str], path: str) -> None:
    """Check that `networks` read the terms that they were trained with, and that actions are the same.

    Networks of equal sizes would otherwise read other terms.

    Args:
        saved: Result of `term_shapes`, from the checkpoint; None if unknown.
        now: The same of the environments.
        networks: Networks to load.
        path: Checkpoint file, for messages.

    Raises:
        CheckpointError: names, order or shapes differ.
    """
    # Older files lack both, and environments without managers the second.
    found = {name: now[name] for name in (*networks, "actions") if now.get(name)}
    if reason := other_terms(saved or {}, found):
        raise CheckpointError(f"Checkpoint {path!r} {reason}")


def other_terms(trained: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Return how the terms `now` differ from those a policy was `trained` with; empty if they do not.

    Both are names, in order, with shapes or texts by name of what reads or has the terms. Names that
    `trained` lacks are unknown.
    """
    lines = [
        f"  {name}: trained with {_listed(trained[name])}; got {_listed(terms)}"
        for name, terms in now.items()
        if name in trained and list(trained[name].items()) != list(terms.items())
    ]
    if not lines:
        return ""
    return (
        "was trained with other terms, or in another order:\n"
        + "\n".join(lines)
        + "\nUse the task as it was trained, or train again."
    )


def _listed(terms: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {shape}".rstrip() for name, shape in terms.items()) or "nothing"


# Exact resume.


def capture_training_state(
    env: VecEnv, algorithm: Any, logger_state: dict[str, Any], observations: TensorDict
) -> dict[str, Any]:
    """Return the state between two iterations; `observations` are those of the next action."""
    unwrapped: Any = getattr(env, "unwrapped", env)
    # Resets write to hidden states.
    hidden = [copy.deepcopy(model.get_hidden_state()) for model in _models(algorithm)]
    state: dict[str, Any] = {
        "version": VERSION,
        "num_envs": env.num_envs,
        "rng": rng_state(),
        # Keys of nested groups are joined by a newline.
        "observations": dict(observations.flatten_keys("\n").clone().items()),
        "logger": logger_state,
        "hidden_states": [list(one) if isinstance(one, tuple) else one for one in hidden],
        "rnd": None,
    }
    if (rnd := getattr(algorithm, "rnd", None)) is not None:
        average = getattr(rnd.reward_normalizer, "disc_avg", None)
        state["rnd"] = {
            "update_counter": rnd.update_counter,
            "discounted_average": None if average is None else average.avg,
        }
    if hasattr(unwrapped, "state_dict"):
        state["env"] = unwrapped.state_dict()
    return state


def lasting_state(state: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a training state that new episodes continue: curricula and totals."""
    lasting = {name: state[name] for name in ("version", "num_envs", "logger", "rnd")}
    if (curricula := curricula_of({"training_state": state})) is not None:
        lasting["env"] = {"curriculum": curricula}
    return lasting


def curricula_of(content: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the curriculum state in the content of a checkpoint, None if it has none."""
    env = (content.get("training_state") or {}).get("env")
    is_ours = isinstance(env, dict) and ("curriculum" in env or "config_edits" in env)
    return curricula_in(env) if is_ours else None


@contextlib.contextmanager
def naming_checkpoint(path: str | os.PathLike[str], *passing: type[Exception]) -> Generator[None]:
    """Convert errors of the block, which reads entries of a checkpoint, to `CheckpointError`.

    Args:
        path: Checkpoint file.
        passing: Types of errors that are not converted, besides those of mjlab.
    """
    try:
        yield
    except (MjlabError, torch.OutOfMemoryError, MemoryError, *passing):
        raise
    except Exception as error:
        # A state of the wrong form raises any error.
        raise unusable(path, f"malformed ({type(error).__name__}: {error})") from error


def restore_lasting_state(state: dict[str, Any], env: VecEnv, algorithm: Any = None) -> list[str]:
    """Restore what outlives episodes in a training state, mainly curricula.

    Call `start_episodes` afterwards. Returns the names of parts left out.
    """
    rnd = getattr(algorithm, "rnd", None)
    if rnd is not None and state.get("rnd") is not None:
        # Its weight follows a schedule.
        rnd.update_counter = index(state["rnd"]["update_counter"])
    curricula = curricula_of({"training_state": state})
    unwrapped: Any = getattr(env, "unwrapped", env)
    if not hasattr(unwrapped, "load_curriculum_state"):
        return []
    if curricula is None:
        return ["curricula"]
    # Tensors created in the rollout can only be written to in inference mode.
    with torch.inference_mode():
        return unwrapped.load_curriculum_state(curricula)


def start_episodes(env: VecEnv) -> None:
    """Start new episodes in environments with curricula, which keep their state."""
    manager = getattr(getattr(env, "unwrapped", env), "curriculum_manager", None)
    if manager is not None:
        with torch.inference_mode(), manager.held():
            env.reset()  # ty: ignore[missing-attribute]


def restore_training_state(
    state: dict[str, Any],
    env: VecEnv,
    algorithm: Any,
    load_logger: Callable[[dict[str, Any]], None],
    device: str | torch.device,
) -> TensorDict:
    """Restore the result of `capture_training_state`; return the observations of the next action.

    Args:
        state: Captured state.
        env: Environments.
        algorithm: An rsl_rl algorithm, or one with its methods, on `device`.
        load_logger: Function that restores the state of the logger.
        device: Device of the networks.

    Raises:
        ValueError: the state is of different environments. Nothing was changed.
    """
    observations = _matching_observations(state, env)
    unwrapped: Any = getattr(env, "unwrapped", env)
    if "env" in state and hasattr(unwrapped, "load_state_dict"):
        # Tensors created in the rollout can only be written to in inference mode.
        with torch.inference_mode():
            unwrapped.load_state_dict(to_device(state["env"], env.device))
    load_logger(state["logger"])
    for model, hidden in zip(_models(algorithm), state["hidden_states"], strict=True):
        hidden = to_device(hidden, device)
        model.reset(hidden_state=tuple(hidden) if isinstance(hidden, list) else hidden)
    if hasattr(algorithm, "last_hidden_states"):
        # rsl_rl's distillation starts an update with the hidden states before the iteration.
        algorithm.last_hidden_states = (algorithm.student.get_hidden_state(), None)
    rnd = getattr(algorithm, "rnd", None)
    if rnd is not None and state["rnd"] is not None:
        rnd.update_counter = index(state["rnd"]["update_counter"])
        if (average := getattr(rnd.reward_normalizer, "disc_avg", None)) is not None:
            average.avg = to_device(state["rnd"]["discounted_average"], device)
    observations = observations.to(device)
    # Last, because restoring may draw random numbers.
    set_rng_state(state["rng"])
    return observations


def _matching_observations(state: dict[str, Any], env: VecEnv) -> TensorDict:
    """Return the observations of `state`; raise ValueError if it is of different environments."""
    # Loads torch's compiler, which takes seconds; `train TASK --help` imports this module.
    from tensordict import TensorDict

    if state.get("version") != VERSION:
        raise ValueError(f"training_state version: expected {VERSION}, got {state.get('version')}.")
    if state["num_envs"] != env.num_envs:
        raise ValueError(
            f"training_state num_envs: expected {env.num_envs}, got {state['num_envs']}; use --num-envs "
            f"{state['num_envs']}."
        )
    observations = state.get("observations")
    if observations is None:
        raise ValueError("The run failed within an iteration, so the checkpoint has no episodes.")
    expected, found = (
        {name: tuple(value.shape) for name, value in group.items()}
        for group in (env.get_observations().flatten_keys("\n"), observations)
    )
    if expected != found:
        raise ValueError(f"training_state observations: expected {expected}, got {found}.")
    return TensorDict(observations, batch_size=[env.num_envs]).unflatten_keys("\n")


def _models(algorithm: Any) -> list[Any]:
    return [getattr(algorithm, name) for name in _NETWORKS if hasattr(algorithm, name)]


# Legacy layouts.


def migrate(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """Return `checkpoint` in the current layout; the argument is not modified.

    Two legacy layouts are supported: one state dict for actor and critic together
    (`model_state_dict`), and an actor whose standard deviation is named `std` or `log_std`.
    """
    migrated = dict(checkpoint)
    if migrated.get("model_state_dict") is not None:
        parts: dict[str, dict[str, Any]] = {"actor_state_dict": {}, "critic_state_dict": {}}
        for name, value in migrated.pop("model_state_dict").items():
            name = str(name)
            if name in _STD_NAMES:
                parts["actor_state_dict"][name] = value
            for prefix, (part, current) in _SINGLE_MODEL_PREFIXES.items():
                if name.startswith(prefix):
                    parts[part][current + name.removeprefix(prefix)] = value
        migrated.update(parts)
    if migrated.get("actor_state_dict") is not None:
        migrated["actor_state_dict"] = {
            _STD_NAMES.get(name, name): value
            for name, value in migrated["actor_state_dict"].items()
        }
    return migrated


# Plain data.


def copied(value: Any) -> Any:
    """Return a copy of nested plain data, in which no two tensors share memory."""
    if isinstance(value, torch.Tensor):
        return value.detach().clone(memory_format=torch.contiguous_format)
    if isinstance(value, (list, tuple)):
        return type(value)(copied(item) for item in value)
    if not isinstance(value, dict):
        return copy.deepcopy(value)
    # State dicts of modules carry versions as an attribute.
    new = copy.copy(value)
    for key, item in value.items():
        new[key] = copied(item)
    return new


def as_plain_data(value: Any, path: str = "") -> Any:
    """Return `value` with NumPy scalars converted to Python's; tensors are not copied.

    Args:
        value: Tensors, numbers, strings, None, and dicts, lists, tuples and sets of those.
        path: Position of `value` in the file, for the message.

    Raises:
        TypeError: `value` holds another type; the message has its position and type.
    """
    if isinstance(value, np.generic):
        value = value.item()
    kind = type(value)
    if kind in _ATOMS:
        return value
    if kind in _SEQUENCES:
        return kind(as_plain_data(item, f"{path}[{index}]") for index, item in enumerate(value))
    if kind not in _DICTS:
        raise TypeError(f"{path or 'value'} is a {kind.__module__}.{kind.__qualname__}")
    # A copy instead of a new dict: state dicts of modules carry versions as an attribute.
    plain = copy.copy(value)
    plain.clear()
    for key, item in value.items():
        place = f"{path}.{key}" if path else str(key)
        plain[as_plain_data(key, f"a key of {path or 'value'}")] = as_plain_data(item, place)
    return plain
