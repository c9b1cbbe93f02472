"""Command lines: arguments, flags, errors, devices."""

from __future__ import annotations

import importlib
import inspect
import io
import logging
import operator
import os
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from commands import SMALL

from mjlab.cli import main as cli
from mjlab.cli.main import Command, run_command, run_subcommand
from mjlab.rl.checkpoint import CheckpointError
from mjlab.sim.engine import EngineUnavailableError
from mjlab.tasks.registry import UnknownTaskError
from mjlab.utils.errors import UserError
from mjlab.utils.signals import Interrupted
from mjlab.utils.tracebacks import users_lines
from mjlab.viewer.offscreen_renderer import RenderingUnavailableError

ROOT = Path(__file__).parents[2]
TASK = "Mjlab-Cartpole-Swingup"


def ended(command, capsys) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as caught:
        run_command(command)
    streams = capsys.readouterr()
    assert isinstance(caught.value.code, int)
    return caught.value.code, streams.out, streams.err


@pytest.fixture
def failing(capsys, monkeypatch):
    """Return a function that runs a command which raises; gives its status and messages."""
    monkeypatch.setattr(cli.logging, "captureWarnings", lambda capture: None)
    monkeypatch.setattr(cli.logging, "basicConfig", lambda **kwargs: None)
    monkeypatch.setattr(cli.warnings, "formatwarning", cli.warnings.formatwarning)

    def fail(error: BaseException):
        def command(argv):
            raise error

        return ended(command, capsys)

    return fail


@pytest.mark.parametrize(
    "kind",
    [UserError, UnknownTaskError, ValueError, OSError, CheckpointError, EngineUnavailableError,
     RenderingUnavailableError],
)  # fmt: skip
def test_an_error_that_a_user_can_mend_is_one_message_and_status_1(failing, kind):
    status, out, err = failing(kind("Do this instead."))
    assert (status, out) == (1, "")
    assert err.endswith(
        f"\nerror: Do this instead.\n(Set {cli.TRACEBACK_VARIABLE}=1 for the traceback.)\n"
    )


def test_the_traceback_of_such_an_error_is_there_for_the_asking(failing, monkeypatch):
    monkeypatch.setenv(cli.TRACEBACK_VARIABLE, "1")
    _, _, err = failing(UserError("No."))
    assert "Traceback" in err
    assert "raise error" in err


def test_an_error_shows_only_lines_of_users_code(failing, capsys):
    status, _, err = failing(AttributeError("oops"))
    assert status == 1
    assert err.startswith("Traceback (most recent call last):\n")
    assert [line.split('"')[1] for line in err.splitlines() if "  File " in line] == [__file__]
    assert "\nerror: AttributeError: oops\n" in err


@pytest.mark.parametrize(
    "place",
    ["lib/python3.11/site-packages/torch/nn.py", "lib/python3/dist-packages/numpy/core.py", "t.py"],
)
def test_installed_packages_are_not_users_code(tmp_path, place):
    file = tmp_path / place
    file.parent.mkdir(parents=True, exist_ok=True)
    code = compile("raise KeyError('x')", str(file), "exec")
    with pytest.raises(KeyError) as caught:
        exec(code)
    # The frame of this test is dropped.
    error = caught.value.with_traceback(caught.tb.tb_next)
    assert ("t.py" in users_lines(error)) == (place == "t.py")


def test_users_code_cannot_end_a_command_in_silence(failing):
    class Silent(Exception):
        def __str__(self):
            raise TypeError("no text")

    for error in (SystemExit(), SystemExit(0), BrokenPipeError("mine"), Silent()):
        status, _, err = failing(error)
        assert status == 1
        assert __file__ in err
        assert f"\nerror: {type(error).__name__}" in err or "\nerror: mine\n" in err


def test_the_first_cause_in_users_code_is_shown(capsys):
    def term(argv):
        raise KeyError("height")

    def command(argv):
        try:
            term(argv)
        except KeyError as error:
            raise UserError("The term failed.") from error

    status, _, err = ended(command, capsys)
    assert (status, "in term" in err) == (1, True)
    assert "\nerror: The term failed.\n" in err


def test_the_traceback_of_a_defect_is_kept_in_a_file(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    # Python's function, called without a line of a user.
    status, _, err = ended(operator.itemgetter("height"), capsys)
    assert status == 1
    assert err.startswith("error: TypeError: ")
    (file,) = tmp_path.iterdir()
    assert str(file) in err
    assert "Traceback" in file.read_text()
    assert "Traceback" not in err


def test_errors_of_this_package_are_messages(capsys, failing):
    failing(UserError("."))  # Applies the fixture's patches.
    from mjlab.actuator import XmlActuatorCfg
    from mjlab.scene import Scene, SceneCfg

    def unknown_entity(argv):
        Scene(SceneCfg(), device="cpu")["robot"]

    def wrong_arguments(argv):
        XmlActuatorCfg(no_such_field=1)  # ty: ignore

    status, _, err = ended(unknown_entity, capsys)
    assert status == 1
    assert "\nerror: Unknown entity or sensor 'robot'; " in err
    assert "no_such_field" in ended(wrong_arguments, capsys)[2]


def test_text_that_cannot_be_encoded_is_named(failing, run, tmp_path):
    path = f"{tmp_path}/log\udcff"
    message = run("train", TASK, *SMALL, "--log-root", path).message
    assert ascii(path)[1:-1] in message
    assert "LC_ALL=C.UTF-8" in message
    # Text of the user's own code is no path.
    _, _, err = failing(UnicodeEncodeError("ascii", "\xe4", 0, 1, "ordinal not in range(128)"))
    assert "\nerror: 'ascii' codec can't encode" in err


def test_an_error_without_a_text_is_called_by_its_name(failing):
    assert "\nerror: ValueError\n" in failing(ValueError())[2]


def test_an_error_may_have_another_status(failing):
    class BadCallError(UserError):
        exit_status = 2

    assert failing(BadCallError("No."))[0] == 2


def test_an_interrupt_ends_with_its_customary_status_and_no_message(failing):
    assert failing(KeyboardInterrupt()) == (130, "", "")
    assert failing(Interrupted(signal.SIGTERM)) == (143, "", "")


_INTERRUPTED = "import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(30)\n"


@pytest.mark.skipif(sys.platform == "win32", reason="no signals")
@pytest.mark.parametrize(
    "command",
    [
        ("-m", "mjlab.scripts.train"),
        ("-m", "mjlab.cli.main", "train"),
        ("-c", "import sys; sys.argv[0] = 'train'; from mjlab.cli.main import main; main()"),
    ],
)
def test_ctrl_c_while_modules_load_is_quiet(tmp_path, command):
    for name in ("torch", "mujoco"):
        (tmp_path / f"{name}.py").write_text(_INTERRUPTED)
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, *command, TASK],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    # 130 in a shell.
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")


@pytest.mark.skipif(sys.platform == "win32", reason="no signals")
def test_programs_of_users_keep_keyboard_interrupt(tmp_path):
    (tmp_path / "package").mkdir()
    (tmp_path / "package/__init__.py").write_text("import mjlab.scripts\n")
    (tmp_path / "package/program.py").write_text(
        "import os, signal\n"
        "try:\n    os.kill(os.getpid(), signal.SIGINT)\n"
        "except KeyboardInterrupt:\n    print('caught')\n"
    )
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, "-m", "package.program", "mjlab.scripts.train"],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, "caught\n")


@pytest.mark.parametrize("handler", [signal.default_int_handler, signal.SIG_DFL])
def test_commands_keep_the_handler_of_ctrl_c(failing, handler):
    previous = signal.signal(signal.SIGINT, handler)
    try:
        command = Command("one", "", "", module="module_that_is_missing")
        with pytest.raises(ModuleNotFoundError):
            run_subcommand(command, [], "one")
        assert signal.getsignal(signal.SIGINT) == handler
        failing(ValueError())
        assert signal.getsignal(signal.SIGINT) == handler
    finally:
        signal.signal(signal.SIGINT, previous)


@pytest.mark.skipif(sys.platform == "win32", reason="no signals")
def test_ctrl_c_while_python_ends_is_quiet():
    program = (
        "import atexit\nfrom mjlab.cli.main import run_command\n"
        f"run_command(lambda argv: atexit.register(exec, {_INTERRUPTED!r}, {{}}))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (-signal.SIGINT, b"")


def test_a_thread_without_memory_ends_the_command():
    """Its starter would wait for ever."""
    program = (
        "import _thread, threading, time\nfrom mjlab.cli.main import run_command\n"
        "class Starved(threading.Thread):\n"
        "    def fail(self):\n        raise MemoryError\n"
        "def command(argv):\n"
        "    _thread.start_new_thread(Starved().fail, ())\n    time.sleep(30)\n"
        "run_command(command)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=20, check=False
    )
    assert done.returncode == 1
    assert done.stderr.startswith("error: Out of memory: a thread did not start.")


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_reader_that_has_seen_enough_causes_no_message(unbuffered):
    command = f"{sys.executable} -m mjlab.scripts.train --help | true"
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, env=environment)
    assert done.stderr == ""


@pytest.fixture
def mjlab(run_main):
    """Return a function that runs `mjlab` with arguments."""
    return lambda *argv: run_main(cli.main, "mjlab", *argv)


@pytest.mark.parametrize("argv", [[], ["-h"], ["--help"]])
def test_without_a_task_the_usage_is_printed(run, argv):
    outcome = run("train", *argv)
    assert outcome.status == 0
    assert outcome.out.startswith("usage: train TASK")


def test_the_task_comes_first(run):
    outcome = run("train", "--a", "1", TASK)
    assert outcome.status == 1
    assert "'--a'" in outcome.message
    assert "TASK" in outcome.message


def test_an_unknown_task_is_answered_with_the_nearest_names(run):
    message = run("play", "Mjlab-Cartpole-Swing-Up").message
    assert "'Mjlab-Cartpole-Swing-Up'" in message
    assert TASK in message
    assert "list-envs" in message


@pytest.mark.parametrize("command", cli.COMMANDS, ids=lambda command: command.name)
def test_every_command_has_help_a_line_in_the_overview_and_a_function(mjlab, command):
    assert f" {command.name} " in cli.overview()
    assert command.summary in cli.overview()
    outcome = mjlab(command.name, "--help")
    assert outcome.status == 0, outcome.err
    assert outcome.out.startswith(f"usage: mjlab {command.name}")
    module = importlib.import_module(f"mjlab.scripts.{command.name.replace('-', '_')}")
    assert list(inspect.signature(module.command).parameters) == ["argv", "prog"]


def test_commands_are_installed_under_their_names():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["scripts"] == dict.fromkeys(("mjlab", *cli.ALIASES), "mjlab.cli.main:main")


@pytest.mark.parametrize(
    ("program", "usage"),
    [
        ("train", "usage: train TASK"),
        ("list_envs", "usage: list-envs"),
        ("/usr/bin/export-scene", "usage: export-scene TARGET"),
        ("viz-nan.exe", "usage: viz-nan DUMP"),
        ("mjlab", "usage: mjlab COMMAND"),
        ("train.py", "usage: mjlab COMMAND"),
    ],
)
def test_the_name_of_the_program_selects_the_command(run_main, program, usage):
    assert run_main(cli.main, program, "--help").out.startswith(usage)


def test_underscores_and_unknown_commands(mjlab):
    assert mjlab("list_envs", "--keyword", "Swingup").out.strip().startswith(f"1  {TASK}")
    outcome = mjlab("trian", TASK)
    assert outcome.status == 2
    assert "'trian'" in outcome.message
    assert "'train'" in outcome.message


def test_the_overview_and_the_version_load_nothing_heavy():
    for flag in ("--help", "--version"):
        code = (
            f"import sys; sys.argv = ['mjlab', {flag!r}]\n"
            "from mjlab.cli.main import main\n"
            "try: main()\n"
            "except SystemExit as end: assert end.code == 0\n"
            "assert not {'torch', 'mujoco', 'tyro', 'numpy', 'rich'} & set(sys.modules)"
        )
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout.strip()


@pytest.mark.parametrize(
    "arguments",
    [["list_envs"], ["train", "--help"], ["play", "--help"], ["verify", "--help"]],
)
def test_what_only_answers_loads_nothing_heavy(arguments):
    code = (
        "import sys\n"
        f"sys.argv = {arguments!r}\n"
        "from mjlab.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as ended:\n    assert ended.code == 0\n"
        "heavy = {'torch', 'mujoco', 'numpy', 'tyro', 'rich', 'yaml', 'rsl_rl'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    environment = {**os.environ, "PYTHONWARNINGS": "error"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("argv", "policy"), [(["-m"], "passive"), (["program"], None)])
def test_idle_threads_of_torch_sleep_in_commands_that_are_run_as_modules(argv, policy):
    # Set before the command's module, and torch with it, is imported. Programs decide themselves.
    code = f"import sys; sys.argv = {argv}; import mjlab.scripts, os; "
    code += "print(os.environ.get('OMP_WAIT_POLICY'))"
    environment = {k: v for k, v in os.environ.items() if k != "OMP_WAIT_POLICY"}
    command = [sys.executable, "-c", code]
    told = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert told.stdout.strip() == str(policy)


def test_log_messages_go_to_the_stderr_of_the_moment(monkeypatch):
    """The panel of training redirects it, so that messages appear above the panel."""
    handler = cli._StderrHandler()
    panel = io.StringIO()
    monkeypatch.setattr(sys, "stderr", panel)
    handler.emit(logging.makeLogRecord({"msg": "NaN loss"}))
    assert panel.getvalue() == "NaN loss\n"


def test_a_warning_is_printed_once_however_many_environments_are_built():
    program = (
        "import warnings\n"
        "from mjlab.cli.main import run_command\n"
        "def command(argv):\n"
        "    for _ in range(2):\n"
        "        with warnings.catch_warnings():\n"
        "            warnings.simplefilter('always')\n"
        "            warnings.warn('base left behind')\n"
        "run_command(command)\n"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert run.stderr == "UserWarning: base left behind\n"
