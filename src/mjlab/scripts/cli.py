"""What the command lines share: finding the task, parsing flags, and one clear message per error.

Nothing heavy is imported here, so that `--help` and a mistyped task name answer at once.
"""

from __future__ import annotations

import linecache
import logging
import os
import sys
import traceback
import warnings
from collections.abc import Callable
from dataclasses import fields
from typing import Any, NoReturn, TypeVar

C = TypeVar("C")

TRACEBACK_VARIABLE = "MJLAB_TRACEBACK"

# Exit status of a process that gave up because another of its run failed.
OTHER_PROCESS_STATUS = 3

# Errors that a user can mend, of modules that are imported only where they are needed.
_OTHER_PROCESS = ("mjlab.rl.distributed", "OtherProcessError")
_LAZY_ERRORS = (
    ("mjlab.sim.engine", "EngineUnavailableError"),
    ("mjlab.rl.checkpoint", "CheckpointError"),
    ("mjlab.viewer.offscreen_renderer", "RenderingUnavailableError"),
    _OTHER_PROCESS,
)


# How Python, the loader of libraries, MuJoCo and torch, on a CPU and a GPU, say that memory is short.
_OUT_OF_MEMORY = (
    "can't start new thread",
    "failed to map segment",
    "can't allocate memory",
    "Could not allocate memory",
    "out of memory. Tried to allocate",
)
_LONGEST_MESSAGE = 8000


class UserError(Exception):
    """A mistake in what was asked for, told in one message."""

    exit_status = 1
    """Exit status of the command."""


class BadCallError(UserError):
    """A mistake in the command line itself, found before anything is built."""

    exit_status = 2


def run_command(command: Callable[[list[str]], None]) -> NoReturn:
    """Run `command` with the command line's arguments and exit.

    An error that a user can mend is printed as one message, and the exit status is 1 or that of a
    `UserError`. Anything else is a defect of the program and keeps its traceback.
    """
    # torch's idle threads would otherwise spin, and take the cores from the physics threads.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # Scripts report to people: plain messages of the libraries, and warnings as one line each.
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    logging.getLogger("mjlab").setLevel(logging.INFO)
    logging.captureWarnings(True)
    warnings.formatwarning = _one_line  # ty: ignore[invalid-assignment]
    try:
        command(sys.argv[1:])
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:
        # Whoever read the output (`| head`) has seen enough. What is still buffered has nowhere
        # to go, and Python would complain about it at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        if _is_out_of_memory(error):
            # What was raised says where the memory ended, and not that it did.
            error = UserError(
                f"Memory or threads are not enough ({_text(error)}). Use fewer environments, or raise "
                "the limits (ulimit)."
            )
        elif not isinstance(error, _user_errors()) and not _raised_on_purpose(error):
            raise
        if os.environ.get(TRACEBACK_VARIABLE):
            traceback.print_exc()
        blameless = isinstance(error, _classes(_OTHER_PROCESS))
        rank = os.environ.get("RANK", "0")
        # Of several processes, the one that failed and the first have something to say.
        if rank == "0" or not blameless:
            _print_error(error, rank)
        status = error.exit_status if isinstance(error, UserError) else 1
        sys.exit(OTHER_PROCESS_STATUS if blameless else status)
    sys.exit(0)


def _is_out_of_memory(error: Exception) -> bool:
    said = str(error)
    return isinstance(error, MemoryError) or any(text in said for text in _OUT_OF_MEMORY)


def _print_error(error: BaseException, rank: str) -> None:
    process = "" if rank == "0" else f" in process {rank}"
    print(f"error{process}: {_text(error)}", file=sys.stderr)
    print(f"(Set {TRACEBACK_VARIABLE}=1 for where it came from.)", file=sys.stderr)


def _one_line(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    return f"{category.__name__}: {message}"


def _user_errors() -> tuple[type[BaseException], ...]:
    from mjlab.tasks.registry import UnknownTaskError

    return (UserError, UnknownTaskError, ValueError, OSError, *_classes(*_LAZY_ERRORS))


def _classes(*names: tuple[str, str]) -> tuple[type[BaseException], ...]:
    # Classes of modules that were never imported cannot have been raised.
    return tuple(
        getattr(sys.modules[module_name], class_name)
        for module_name, class_name in names
        if module_name in sys.modules
    )


def _raised_on_purpose(error: BaseException) -> bool:
    """Return whether `error` is a message of ours, such as a KeyError for an unknown entity.

    Errors of other kinds than a user can mend are defects, unless a `raise` statement of this
    package made them: then their text says what is wrong with a task.
    """
    frames = list(traceback.walk_tb(error.__traceback__))
    if not frames or isinstance(error, AssertionError):
        return False
    frame, number = frames[-1]
    line = linecache.getline(frame.f_code.co_filename, number)
    ours = frame.f_globals.get("__name__", "").startswith("mjlab.")
    return ours and line.lstrip().startswith("raise ")


def _text(error: BaseException) -> str:
    # A KeyError shows its text in quotes.
    text = str(error.args[0] if isinstance(error, KeyError) and error.args else error).strip()
    return _cut(text) if text else type(error).__name__


def _cut(text: str) -> str:
    """Return `text`; if it is of a damaged file, say, only its beginning and its end."""
    half = _LONGEST_MESSAGE // 2
    return text if len(text) <= _LONGEST_MESSAGE else f"{text[:half]} [...] {text[-half:]}"


def tell(message: str) -> None:
    """Print a notice for people. Standard output is left to what the command is asked for."""
    print(_cut(message), file=sys.stderr, flush=True)


def first_and_flags(
    argv: list[str], usage: str, what: str, may_ask_help: list[str]
) -> tuple[str, list[str]]:
    """Split the command line into `what` comes first, and the flags.

    Without arguments, or with `--help` among `may_ask_help`, prints `usage` and exits.

    Raises:
        UserError: flags before it.
    """
    if not argv or {"-h", "--help"} & set(may_ask_help):
        print(usage)
        sys.exit(0)
    if argv[0].startswith("-"):
        raise UserError(f"The {what} comes first, before {argv[0]!r}.\n\n{usage}")
    return argv[0], argv[1:]


def task_and_flags(argv: list[str], usage: str) -> tuple[str, list[str]]:
    """Split the command line into the task's name, which comes first, and its flags.

    Without arguments, or with only `--help`, prints `usage` and exits.

    Raises:
        UnknownTaskError: no such task; the message lists the nearest names.
        UserError: flags before the task.
    """
    task, flags = first_and_flags(argv, usage, "task's name", argv[:1])
    from mjlab.tasks.registry import require_task

    require_task(task)
    return task, flags


def parse_flags(config_type: type[C], default: C, flags: list[str], prog: str) -> C:
    """Return `default` with the fields replaced that `flags` name; exits on an unknown flag.

    `--env.rewards.<term> None`, and the like for every other kind of term, switches the term off;
    `None` also removes a config inside another where the field may be None, such as a term's noise.
    """
    import tyro

    arguments = _arguments(config_type, default, flags, prog)
    return tyro.cli(config_type, **arguments)


def parse_known_flags(
    config_type: type[C], default: C, flags: list[str], prog: str
) -> tuple[C, list[str]]:
    """Return what `parse_flags` does, and the flags that are unknown, which have no effect."""
    import tyro

    arguments = _arguments(config_type, default, flags, prog)
    return tyro.cli(config_type, return_unknown_args=True, **arguments)


def _arguments(config_type: Any, default: Any, flags: list[str], prog: str) -> dict[str, Any]:
    import mjlab
    from mjlab.scripts.flag_values import flag_rules
    from mjlab.scripts.switch_off import switch_terms_off

    edited, flags = switch_terms_off(default, flags)
    return {
        "default": edited,
        "args": _with_explicit_switches(config_type, flags),
        "prog": prog,
        "config": mjlab.TYRO_FLAGS,
        "registry": flag_rules(),
    }


def is_given(flag: str, flags: list[str]) -> bool:
    """Return whether the command line `flags` sets `flag`, with `-` or `_` between its words."""
    return any(word.partition("=")[0].replace("_", "-") == flag for word in flags)


def _with_explicit_switches(config_type: Any, flags: list[str]) -> list[str]:
    """Read a bare `--video` as `--video True`, for the switches of `config_type` itself."""
    switches = {
        "--" + field.name.replace("_", "-")
        for field in fields(config_type)
        if field.type in ("bool", bool)
    }
    explicit: list[str] = []
    for position, flag in enumerate(flags):
        explicit.append(flag)
        following = flags[position + 1] if position + 1 < len(flags) else None
        bare = following is None or following.startswith("--")
        if flag.replace("_", "-") in switches and bare:
            explicit.append("True")
    return explicit


def resolve_device(device: str | None) -> str:
    """Return the torch device to use: the one asked for, else a GPU where there is one.

    Raises:
        UserError: a CUDA device without a usable GPU, or a name that torch does not know.
    """
    import torch

    if device is None:
        return "cuda:0" if torch.cuda.is_available() else "cpu"
    try:
        kind = torch.device(device).type
    except RuntimeError as error:
        raise UserError(
            f"{device!r} is not a device. Use cpu, cuda, or cuda:0, cuda:1, ..."
        ) from error
    if kind == "cuda" and not torch.cuda.is_available():
        raise UserError(
            f"--device {device} was asked for, but torch finds no CUDA GPU here "
            f"(torch {torch.__version__}). Use --device cpu, or install a driver and a CUDA build "
            "of torch."
        )
    return "cuda:0" if device == "cuda" else device


def task_usage(name: str, purpose: str, examples: list[str]) -> str:
    """Return the short help that is printed when no task is named."""
    lines = [f"usage: {name} TASK [flags]", "", purpose, ""]
    lines += ["examples:", *(f"    uv run {example}" for example in examples), ""]
    lines += [
        f"`{name} TASK --help` lists every flag of the task; `list-envs` lists the tasks.",
    ]
    return "\n".join(lines)
