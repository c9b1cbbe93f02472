"""The command `mjlab`: table of subcommands, dispatch, and errors as one message each.

`train`, `play` and some others are also installed as separate commands. Only the standard library is
imported before a command runs, so that `--help` and a mistyped task name answer at once.
"""

from __future__ import annotations

import atexit
import gc
import io
import logging
import os
import sys
import threading
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mjlab.cli import LOADS_AS_MODULE, prepare_threads
from mjlab.utils.errors import BadCallError, MjlabError, UserError, check_exists
from mjlab.utils.lazy import import_to_stay
from mjlab.utils.logging import shorten
from mjlab.utils.processes import OtherProcessError
from mjlab.utils.signals import Interrupted, end_by_interrupt
from mjlab.utils.tracebacks import users_lines

TRACEBACK_VARIABLE = "MJLAB_TRACEBACK"

# Out-of-memory messages of Python, the dynamic loader, MuJoCo and torch (CPU, GPU).
_OUT_OF_MEMORY = (
    "can't start new thread",
    "failed to map segment",
    "can't allocate memory",
    "Could not allocate memory",
    "out of memory. Tried to allocate",
    "Failed to alloc",
)
_NO_THREAD = b"error: Out of memory: a thread did not start. Use fewer environments, or raise the limits (ulimit).\n"


@dataclass(frozen=True)
class Command:
    """Subcommand of `mjlab`."""

    name: str
    """Name on the command line."""
    group: str
    """Purpose, the heading in `mjlab --help`. Commands of a group follow each other."""
    summary: str
    """A few words in `mjlab --help`."""
    argument: str | None = None
    """Required first argument: TASK (a registered task), TASK|POLICY or another placeholder. None:
    optional."""
    details: str = ""
    """Text of `--help`. Without `details` and `argument`, the function handles `--help`."""
    examples: tuple[str, ...] = ()
    """Command lines, without `uv run mjlab`."""
    unknown_task_status: int = 1
    """Exit status for an unregistered task."""
    module: str = ""
    """Module with `command(argv, prog)`. Empty: that of `mjlab.scripts` with the same name."""

    def usage(self, prog: str) -> str:
        """Return the help printed by `prog --help`."""
        words = (prog, self.argument, "[flags]")
        lines = [f"usage: {' '.join(filter(None, words))}", "", self.details or self.summary, ""]
        if self.examples:
            lines += [
                "examples:",
                *(f"    uv run mjlab {example}" for example in self.examples),
                "",
            ]
        if self.argument:
            lines.append(f"`uv run mjlab {self.name} {self.argument} --help` shows its flags.")
        if self.argument in _OF_TASKS:
            lines.append("`uv run mjlab list-envs` lists the tasks.")
        return "\n".join(lines).rstrip()


_POLICY = """\
POLICY is the folder of a run, a checkpoint (.pt) or exported policy (.onnx) in it, a folder that
`mjlab publish` wrote, a ZIP archive of one, or hf:NAME/REPO or hf:NAME/REPO@REVISION of the Hugging
Face Hub."""
_OF_TASKS = ("TASK", "TASK|POLICY")

COMMANDS = (
    Command(
        "train",
        "learn",
        "train a policy (checkpoint, ONNX, curve)",
        argument="TASK",
        details="""\
Train a policy, by PPO or, with --learner sac, by SAC. Checkpoints, curves and the exported
policy go to logs/rsl_rl/<experiment>/<time>/.""",
        examples=(
            "train Mjlab-Cartpole-Swingup --profile cpu",
            "train Mjlab-Cartpole-Swingup --num-envs 4096",
            "train Mjlab-Cartpole-Swingup --agent.algorithm.learning-rate 3e-4 --agent.seed 1",
            "train Mjlab-Cartpole-Swingup --agent.resume True",
            "train Mjlab-Velocity-Flat-Unitree-Go1 --learner sac --agent.algorithm.batch-size 1024",
        ),
    ),
    Command(
        "train-seeds",
        "learn",
        "the same task over several seeds",
        argument="TASK",
        details="""\
Train a task once for each seed 1, 2, ..., N (--seeds N, default 5), each run to its last
iteration. All other flags are those of `train`.""",
        examples=(
            "train-seeds Mjlab-Cartpole-Swingup --num-envs 512 --agent.max-iterations 100",
            "plot-seeds logs/rsl_rl/cartpole/*_seed_? --output swingup.png",
        ),
    ),
    Command(
        "sweep",
        "learn",
        "compare settings, side by side",
        argument="TASK",
        details="""\
Train a task with several settings and seeds side by side, and compare them in a table and a
plot. The same command continues an interrupted sweep. All other flags are those of `train`.""",
        examples=(
            "sweep Mjlab-Cartpole-Swingup --over agent.algorithm.learning-rate=1e-4,3e-4,1e-3 --seeds 3",
            "sweep Mjlab-Cartpole-Swingup --over agent.algorithm.learning-rate=1e-5..1e-2:log --trials 20",
        ),
    ),
    Command(
        "plot-seeds",
        "learn",
        "one curve with its spread",
    ),
    Command(
        "verify",
        "learn",
        "compare one seed with reference runs",
        argument="TASK",
        details="""\
Train a task with one seed and check that its learning curve lies within the band of the
reference runs bundled with the package. Exit status: 0 within, 1 outside, 2 invalid command
line.""",
        examples=(
            "verify Mjlab-Cartpole-Swingup",
            "verify Mjlab-Velocity-Flat-Unitree-Go1 --device cpu --seed 1",
        ),
        unknown_task_status=2,
    ),
    Command(
        "demo",
        "watch",
        "drive a robot that can walk, now",
        details="""\
Play a robot that tracks velocity commands, in the browser and offline: a Unitree Go1
(quadruped, `go1`, the default) or G1 (humanoid, `g1`); or a G1 that squats and waves
(`g1-tracking`). Flags are those of `play`.""",
        examples=(
            "demo",
            "demo g1",
            "demo --num-envs 4 --port 8090",
            "demo g1 --viewer none --video True",
        ),
    ),
    Command(
        "play",
        "watch",
        "your newest policy, in the browser",
        argument="TASK|POLICY",
        details=f"""\
Show a trained policy (default: the newest of TASK) in the browser, in MuJoCo's window, or as a
video.

{_POLICY}""",
        examples=(
            "play Mjlab-Cartpole-Swingup",
            "play Mjlab-Cartpole-Swingup --checkpoint-file logs/rsl_rl/cartpole/model_500.pt",
            "play Mjlab-Cartpole-Swingup --agent random --viewer native",
            "play Mjlab-Cartpole-Swingup --viewer none --num-steps 200 --video True",
            "play hf:NAME/REPO",
        ),
    ),
    Command(
        "evaluate",
        "watch",
        "return, errors and falls, with intervals",
        argument="TASK|POLICY",
        details=f"""\
Play episodes with a trained policy (default: the newest of TASK), one per environment, and print the
mean return with a 95 % interval, and the success rate if the task defines success.

{_POLICY}""",
        examples=(
            "evaluate Mjlab-Cartpole-Swingup",
            "evaluate Mjlab-Cartpole-Swingup --num-episodes 1024 --json True",
        ),
    ),
    Command(
        "share",
        "watch",
        "a page to send: episodes in 3-D, curve, evaluation",
        argument="POLICY",
        details=f"""\
Write one HTML file that opens offline in any browser: recorded episodes to turn and scrub in 3-D,
commands, rewards, learning curve, evaluation with its intervals, and where the policy comes from.

{_POLICY} Or a bundled policy (go1, g1, g1-tracking).

Values are those of `evaluate --output`; without it, the page says how to measure.""",
        examples=(
            "share g1 --output g1.html",
            "share logs/rsl_rl/go1_velocity/2026-01-02_03-04-05",
            "share go1 --num-episodes 3 --seconds 6 --num-envs 4",
        ),
    ),
    Command(
        "runs",
        "watch",
        "your runs of a task, their settings and scores",
        argument="TASK",
        details="""\
List the runs of a task, the last started first: state, finished iterations, mean return of the
last evaluation, size on disk, and settings that differ from the task.""",
        examples=(
            "runs Mjlab-Cartpole-Swingup",
            "runs Mjlab-Cartpole-Swingup --json",
        ),
    ),
    Command(
        "list-envs",
        "build",
        "tasks and their profiles",
    ),
    Command(
        "describe",
        "build",
        "what a task observes, rewards and ends",
        argument="TASK",
        details="""\
Print tables of a task: observations (and those that a robot cannot measure), actions, commands,
rewards, terminations, events, curriculum, metrics, entities and sensors. Builds one environment on
the CPU.""",
        examples=(
            "describe Mjlab-Velocity-Flat-Unitree-Go1",
            "describe Mjlab-Velocity-Flat-Unitree-Go1 --profile cpu --json",
            "describe Mjlab-Cartpole-Swingup --env.rewards.smooth-reward.weight 2",
        ),
    ),
    Command(
        "view",
        "build",
        "any MJCF or URDF, with sliders",
        argument="MODEL",
        details="""\
Show a model in the browser: joint and actuator sliders, geom groups, sites, contacts, inertia
and frames. MODEL is a file (MJCF, URDF, MJB or a MuJoCo archive), a robot (g1, go1, yam, or
module:function that returns an EntityCfg) or a task.""",
        examples=(
            "view robot.xml",
            "view robot.urdf",
            "view go1",
            "view Mjlab-Velocity-Rough-Unitree-Go1",
        ),
    ),
    Command(
        "new-robot",
        "build",
        "a package of tasks for a robot of yours",
        argument="MODEL",
        details="""\
Write a small package for a robot: model, initial pose, gains, task, registration and a test, each
value with its reason. MODEL is an MJCF or URDF file, a folder or zip with one and its meshes,
module:function that returns an MjSpec, or menagerie:NAME.""",
        examples=(
            "new-robot robot.xml",
            "new-robot robot.urdf --set floating_base=true --set armature=0.01",
            "new-robot robots.zip --name rex --output ~/rex --install",
        ),
    ),
    Command(
        "check",
        "build",
        "faults of a model or task that MuJoCo accepts",
        argument="TARGET",
        details="""\
Look for faults that MuJoCo accepts and training would meet later: gains, limits, masses, feet,
initial pose, left and right. Each finding has file and line, the reason and the cure.

TARGET is a file (MJCF or URDF), a folder or zip archive with one, menagerie:NAME, a robot (g1,
go1, yam, or module:function that returns an MjSpec or EntityCfg) or a task.""",
        examples=(
            "check robot.xml",
            "check robot.urdf --floating-base",
            "check Mjlab-Velocity-Flat-Unitree-Go1 --profile cpu",
        ),
    ),
    Command(
        "fit-actuators",
        "build",
        "friction, inertia, gains and delay of real joints",
        argument="LOG",
        details="""\
Fit the drives of a robot that hangs by its base to a log of its joints, and print the values with
95 % intervals, what the log cannot separate, and the randomization that follows. LOG is a CSV with
the columns time, target.JOINT, measurement.joint_pos.JOINT and, if measured,
measurement.joint_vel.JOINT and measurement.joint_torque.JOINT; or an NPZ.""",
        examples=(
            "fit-actuators chirp.csv --robot go1",
            "fit-actuators chirp.csv --robot my_robots:get_my_robot_cfg --more steps.csv",
            "fit-actuators chirp.npz --robot robot.xml --stiffness 25 --damping 0.6",
        ),
    ),
    Command(
        "visualize-terrain",
        "build",
        "terrains, in the browser",
    ),
    Command(
        "csv-to-npz",
        "build",
        "recorded joint angles to a motion",
        argument="--input-file FILE",
        details="""\
Convert a CSV of the retargeted LAFAN1 sets (one pose per line: root position, root quaternion x
y z w, all joint angles) to the .npz that motion tracking reads, or resample an .npz to another
rate.""",
        examples=(
            "csv-to-npz --input-file dance1_subject2.csv",
            'csv-to-npz --input-file dance.csv --line-range "(120,720)" --output-file dance.npz --render True',
            "csv-to-npz --input-file dance.csv --view True",
        ),
    ),
    Command(
        "export-scene",
        "build",
        "a task or robot as MuJoCo XML",
        argument="TARGET",
        details="""\
Write scene.xml and its assets, for MuJoCo's viewer and other programs.

TARGET is the name of a task, a robot (g1, go1, yam), or module:function, a function without arguments
that returns an EntityCfg.""",
        examples=(
            "export-scene Mjlab-Velocity-Flat-Unitree-Go1 --output-dir go1_flat",
            "export-scene g1 --zip",
        ),
    ),
    Command(
        "deploy",
        "deploy",
        "a policy as a folder for a robot",
        argument="POLICY",
        details=f"""\
Write a folder that runs a policy without this package and without torch: network (ONNX), contract
(JSON), scene, golden trace, and programs to read.

{_POLICY} Or a bundled policy (go1, g1, g1-tracking).""",
        examples=(
            "deploy go1 --output go1_bundle",
            "deploy logs/rsl_rl/go1_velocity/2026-01-02_03-04-05",
        ),
    ),
    Command(
        "publish",
        "deploy",
        "a policy for others: folder or Hugging Face Hub",
        argument="POLICY",
        details=f"""\
Write a policy as people share them: checkpoint, network (ONNX), settings, evaluation, clip, and a
card (README.md) that states what `mjlab evaluate --output` measured. Logs, replay buffers and paths
of this machine stay here. `play`, `evaluate` and `deploy` take the result.

{_POLICY}""",
        examples=(
            "publish logs/rsl_rl/cartpole/2026-01-02_03-04-05 --to swingup",
            "publish logs/rsl_rl/cartpole/2026-01-02_03-04-05 --to hf:NAME/REPO --license apache-2.0",
            "play hf:NAME/REPO",
        ),
    ),
    Command(
        "check-deploy",
        "find out",
        "where a deployed policy differs from training",
        argument="BUNDLE",
        details="""\
Run the programs of a bundle in plain MuJoCo, and compare with its golden trace: sensors, terms,
history, vector, action, target, torque, and the state after one control step.

At a difference: first step, stage, component, and the likely cause if one explains it; exit status 1.
BUNDLE is a folder that `mjlab deploy` wrote; its programs may have been edited.""",
        examples=("check-deploy bundle", "check-deploy bundle --json"),
    ),
    Command(
        "profile-env",
        "find out",
        "where the time of a step goes",
        argument="TASK",
        details="""\
Step a task with random actions, and print the step time by phase (physics, forward, each
manager) and by term.""",
        examples=(
            "profile-env Mjlab-Cartpole-Swingup",
            "profile-env Mjlab-Cartpole-Swingup --num-envs 4096 --steps 200 --json",
        ),
    ),
    Command(
        "viz-nan",
        "find out",
        "the states before a NaN",
        argument="DUMP",
        details="""\
Show the states that led to a NaN. DUMP is a file written by `train --enable-nan-guard True`,
such as nan_dump_latest.npz; the model is read from the same folder.""",
        examples=("viz-nan /tmp/mjlab/nan_dumps/nan_dump_latest.npz",),
    ),
    Command(
        "completion",
        "shell",
        "complete commands, tasks and flags (bash, zsh, fish)",
    ),
)

ALIASES = (
    "train", "train-seeds", "plot-seeds", "verify", "evaluate", "play", "demo", "list-envs",
    "list_envs", "profile-env", "export-scene", "viz-nan",
)  # fmt: skip
"""Commands that are also installed as separate executables."""

_BY_NAME = {command.name: command for command in COMMANDS}

_START_HERE = (
    "start here uv run mjlab demo",
    "           uv run mjlab train Mjlab-Cartpole-Swingup --profile cpu",
    "",
    "`uv run mjlab COMMAND --help` shows a command, `--version` the version.",
)


def main() -> None:
    """Entry point of `mjlab`, and of the commands that are also installed under their own name."""
    program = Path(sys.argv[0])
    # A user's own `train.py` that calls this function is `mjlab`.
    if program.suffix in ("", ".exe") and (name := program.stem.replace("_", "-")) in _BY_NAME:
        run_alias(name)
    else:
        run_command(_dispatch)


def _dispatch(argv: list[str]) -> None:
    if not argv or argv[0] in ("-h", "--help"):
        print(overview())
        return
    if argv[0] == "--version":
        from importlib.metadata import version

        print(version("mjlab"))
        return
    name = argv[0].replace("_", "-")
    check_exists("command", name, _BY_NAME, BadCallError)
    run_subcommand(_BY_NAME[name], argv[1:], f"mjlab {name}")


def overview() -> str:
    """Return the text of `mjlab --help`: all commands by group."""
    lines = ["usage: mjlab COMMAND [options]", ""]
    width = max(map(len, _BY_NAME))
    group = ""
    for command in COMMANDS:
        heading = "" if command.group == group else command.group
        group = command.group
        lines.append(f"{heading:<10} {command.name:<{width}}  {command.summary}")
    return "\n".join([*lines, "", *_START_HERE])


def run_subcommand(command: Command, argv: list[str], prog: str) -> None:
    """Run a subcommand. Its first argument is checked before heavy modules are imported."""
    argument = command.argument
    # `--help` after the first argument lists all flags.
    asks_help = argv[:1] in (["-h"], ["--help"]) and (argument or command.details)
    if asks_help or (argument and not argv):
        print(command.usage(prog))
        return
    if argument and argv[0].startswith("-") and not argument.startswith("-"):
        raise UserError(f"Expected {argument} first, got {argv[0]!r}.\n\n{command.usage(prog)}")
    if argument in _OF_TASKS:
        from mjlab.tasks.registry import UnknownTaskError, require_task

        try:
            require_task(argv[0])
        except UnknownTaskError as error:
            error.exit_status = command.unknown_task_status
            if argument == "TASK" or not _is_policy(argv[0]):
                raise
    module = command.module or f"mjlab.scripts.{command.name.replace('-', '_')}"
    was_changed = end_by_interrupt(True)
    try:
        implementation = import_to_stay(module)
    finally:
        if was_changed:
            end_by_interrupt(False)
    implementation.command(argv, prog)


def _is_policy(text: str) -> bool:
    """Return True for a path, also of a file that is missing, and for a repository of the Hub."""
    is_file = "/" in text or Path(text).suffix in (".zip", ".pt", ".onnx")
    return is_file or text.startswith("hf:") or Path(text).exists()


def run_alias(name: str) -> None:
    """Run the subcommand `name` with the arguments of this process; exits on errors."""
    run_command(lambda argv: run_subcommand(_BY_NAME[name], argv, name))


# Errors.


class _StderrHandler(logging.StreamHandler):
    """Writes to the current `sys.stderr`, which prints above the panel while training shows one."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a message."""
        self.stream = sys.stderr
        super().emit(record)


class _Once(logging.Filter):
    """Passes each message once per process."""

    def __init__(self) -> None:
        super().__init__()
        self._passed: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True for a message that is new."""
        message = record.getMessage()
        is_new = message not in self._passed
        self._passed.add(message)
        return is_new


def run_command(command: Callable[[list[str]], None]) -> None:
    """Run `command` with the command line's arguments; return if it succeeds, else exit.

    Errors are printed as one message, after the lines of the user's own code that they passed through,
    such as a reward. The exit status is `MjlabError.exit_status`, else 1. A command that a signal ended
    exits with 128 + its number, except while modules load and while Python shuts down, when the signal
    itself ends the process (-2 for `subprocess`, 130 in a shell).
    """
    if LOADS_AS_MODULE:
        end_by_interrupt(False)
    prepare_threads()
    # Plain library messages.
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[_StderrHandler()])
    logging.getLogger("mjlab").setLevel(logging.INFO)
    logging.captureWarnings(True)
    # The environment of evaluations would repeat the warnings of the one that trains.
    logging.getLogger("py.warnings").addFilter(_Once())
    # One line per warning, without file and source line.
    warnings.formatwarning = lambda message, category, *_: f"{category.__name__}: {message}"  # ty: ignore[invalid-assignment]
    # Paths may have characters that the terminal's encoding lacks.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    previous, sys.unraisablehook = sys.unraisablehook, _end_without_threads
    try:
        command(sys.argv[1:])
    except Interrupted as stopped:
        sys.exit(stopped.exit_status)
    except KeyboardInterrupt:
        sys.exit(130)
    except (Exception, SystemExit) as error:
        # Looking for lines takes memory.
        lines = "" if _lacks_memory(error) else users_lines(error)
        if isinstance(error, SystemExit) and (error.code or not lines):
            # Of the parser of flags, of a signal, or with a status that a user chose.
            raise
        # Without such lines, the reader (`| head`) closed the pipe.
        if lines or not isinstance(error, BrokenPipeError):
            _report(error, lines)
        sys.exit(error.exit_status if isinstance(error, MjlabError) else 1)
    finally:
        sys.unraisablehook = previous
        try:
            print(end="", flush=True)
        except BrokenPipeError:
            # Python would report the unwritten output at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        except OSError:
            # Python reports it at exit, such as a full disk.
            pass
        # Before the callbacks that modules registered in the meantime.
        atexit.register(end_by_interrupt, True)
        # Python would search all objects for garbage as it ends, which took 0.8 s.
        atexit.register(gc.freeze)


def _end_without_threads(error: sys.UnraisableHookArgs) -> None:
    """End the process if memory is too short for a thread to start; else report `error` as Python does.

    `threading.Thread.start` would wait for ever for the thread.
    """
    thread = getattr(error.object, "__self__", None)
    if error.exc_type is MemoryError and isinstance(thread, threading.Thread):
        os.write(2, _NO_THREAD)
        os._exit(1)
    sys.__unraisablehook__(error)


def _report(error: BaseException, lines: str) -> None:
    """Print an error as one message, after the `lines` of the user's code that it passed through."""
    rank = os.environ.get("RANK", "0")
    is_elsewhere = isinstance(error, OtherProcessError)
    # Only the failed process and rank 0 report.
    if rank != "0" and is_elsewhere:
        return
    is_memory = _lacks_memory(error)
    lines = "" if is_elsewhere else lines
    is_expected = isinstance(error, (MjlabError, ValueError, OSError)) or is_memory
    hint = f"Set {TRACEBACK_VARIABLE}=1 for the traceback."
    if os.environ.get(TRACEBACK_VARIABLE):
        traceback.print_exc()
    elif lines:
        print(lines, end="", file=sys.stderr)
    elif not is_expected:
        hint = _keep_traceback() or hint
    text = shorten(_text_of(error) or type(error).__name__)
    if is_memory:
        # The original message names the failed call, not the lack of memory.
        text = f"Out of memory or threads ({text}). Use fewer environments, or raise the limits (ulimit)."
    elif isinstance(error, UnicodeEncodeError) and not lines:
        # The original message does not name the text, nearly always a path.
        text = (
            f"Expected text that can be written as {error.encoding}, got {shorten(ascii(error.object))}; rename "
            "the file or folder, or set LC_ALL=C.UTF-8."
        )
    elif not is_expected and text != type(error).__name__:
        text = f"{type(error).__name__}: {text}"
    process = "" if rank == "0" else f" in process {rank}"
    print(f"error{process}: {text}\n({hint})", file=sys.stderr)


def _lacks_memory(error: BaseException) -> bool:
    return isinstance(error, MemoryError) or any(part in _text_of(error) for part in _OUT_OF_MEMORY)


def _text_of(error: BaseException) -> str:
    # The method of a user's class may raise itself.
    try:
        return str(error).strip()
    except Exception:
        return ""


def _keep_traceback() -> str | None:
    """Write the present traceback to a temporary file, because it may be of a defect that took hours to
    appear; return a sentence with its name. None: not written.
    """
    import tempfile

    try:
        number, path = tempfile.mkstemp(prefix="mjlab_error_", suffix=".txt")
        with open(number, "w", encoding="utf-8", errors="backslashreplace") as file:
            traceback.print_exc(file=file)
    except OSError:
        return None
    return f"The traceback is in {path}."


if __name__ == "__main__":
    main()
