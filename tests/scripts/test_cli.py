"""What the command lines share: arguments, flags, errors, devices."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass, field

import pytest

from mjlab.rl.checkpoint import CheckpointError
from mjlab.scripts import cli
from mjlab.scripts.cli import run_command, task_and_flags
from mjlab.scripts.flags import parse_flags, resolve_device
from mjlab.sim.engine import EngineUnavailableError
from mjlab.tasks.registry import UnknownTaskError
from mjlab.utils.errors import UserError
from mjlab.viewer.offscreen_renderer import RenderingUnavailableError

USAGE = "usage: try TASK [flags]"
TASK = "Mjlab-Cartpole-Swingup"


@dataclass
class Inner:
    """Things."""

    rate: float = 1.0
    """A rate."""
    switch: bool = False
    """A switch below the top."""


@dataclass
class Flags:
    """Flags of a command."""

    fast_mode: bool = False
    """A switch."""
    count: int | None = None
    """A number."""
    inner: Inner = field(default_factory=Inner)
    """More."""


def parsed(*flags: str) -> Flags:
    return parse_flags(Flags, Flags(), list(flags), "try")


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
    assert err == (
        f"error: Do this instead.\n(Set {cli.TRACEBACK_VARIABLE}=1 for where it came from.)\n"
    )


def test_the_traceback_of_such_an_error_is_there_for_the_asking(failing, monkeypatch):
    monkeypatch.setenv(cli.TRACEBACK_VARIABLE, "1")
    _, _, err = failing(UserError("No."))
    assert "Traceback" in err
    assert "raise error" in err


def test_a_defect_keeps_its_traceback(failing):
    with pytest.raises(AttributeError, match="oops"):
        failing(AttributeError("oops"))


def test_an_error_of_any_kind_that_this_package_raises_on_purpose_is_a_message(capsys, failing):
    failing(UserError("."))  # Applies the fixture's patches.
    from mjlab.actuator import XmlActuatorCfg
    from mjlab.scene import Scene, SceneCfg

    def unknown_entity(argv):
        Scene(SceneCfg(), device="cpu")["robot"]

    def wrong_arguments(argv):
        XmlActuatorCfg(no_such_field=1)  # ty: ignore

    status, _, err = ended(unknown_entity, capsys)
    assert status == 1
    assert err.startswith("error: The scene has no 'robot'.")
    with pytest.raises(TypeError, match="no_such_field"):
        ended(wrong_arguments, capsys)


def test_an_error_without_a_text_is_called_by_its_name(failing):
    assert failing(ValueError())[2].startswith("error: ValueError\n")


def test_an_error_may_have_another_status(failing):
    class BadCallError(UserError):
        exit_status = 2

    assert failing(BadCallError("No."))[0] == 2


def test_an_interrupt_ends_with_its_customary_status_and_no_message(failing):
    assert failing(KeyboardInterrupt()) == (130, "", "")


def test_a_reader_that_has_seen_enough_causes_no_message():
    command = f"{sys.executable} -m mjlab.scripts.train --help | true"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.stderr == ""


@pytest.mark.parametrize("argv", [[], ["-h"], ["--help"]])
def test_without_a_task_the_usage_is_printed(argv, capsys):
    with pytest.raises(SystemExit) as caught:
        task_and_flags(argv, USAGE)
    assert caught.value.code == 0
    assert capsys.readouterr().out.strip() == USAGE


def test_the_task_comes_first():
    assert task_and_flags([TASK, "--a", "1"], USAGE) == (TASK, ["--a", "1"])
    with pytest.raises(UserError, match=r"comes first, before '--a'"):
        task_and_flags(["--a", "1", TASK], USAGE)


def test_an_unknown_task_is_answered_with_the_nearest_names():
    with pytest.raises(UnknownTaskError) as caught:
        task_and_flags(["Mjlab-Cartpole-Swing-Up"], USAGE)
    assert "'Mjlab-Cartpole-Swing-Up'" in str(caught.value)
    assert f"Did you mean {TASK}" in str(caught.value)
    assert "list-envs" in str(caught.value)


def test_flags_replace_fields_and_leave_the_others():
    flags = parsed("--inner.rate", "3e-4", "--count", "5")
    assert flags == Flags(count=5, inner=Inner(rate=3e-4))
    assert parsed("--count", "None") == Flags()


@pytest.mark.parametrize("flag", ["--fast-mode", "--fast_mode"])
def test_a_switch_needs_no_value_and_takes_one(flag):
    assert parsed(flag) == Flags(fast_mode=True)
    assert parsed(flag, "--count", "2") == Flags(fast_mode=True, count=2)
    assert parsed(flag, "True") == Flags(fast_mode=True)
    assert parsed(flag, "False") == Flags()


@pytest.mark.parametrize(
    ("flags", "named"),
    [(["--cuont", "3"], "--cuont"), (["--count", "many"], "many"), (["stray"], "stray")],
)
def test_a_flag_that_is_not_there_or_not_of_its_kind_ends_with_status_2(flags, named, capsys):
    with pytest.raises(SystemExit) as caught:
        parsed(*flags)
    assert caught.value.code == 2
    assert named in capsys.readouterr().err


def test_a_mistyped_flag_is_answered_with_the_nearest(capsys):
    with pytest.raises(SystemExit):
        parsed("--inner.ratee", "3")
    assert "--inner.rate" in capsys.readouterr().err


def test_parsing_leaves_the_default_as_it_was():
    default = Flags()
    parse_flags(Flags, default, ["--inner.rate", "9", "--fast-mode"], "try")
    assert default == Flags()


@pytest.mark.parametrize(("asked", "device"), [("cpu", "cpu"), ("cuda", "cuda:0")])
def test_the_device_is_the_one_asked_for(asked, device, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    assert resolve_device(asked) == device


@pytest.mark.parametrize(("gpu", "device"), [(False, "cpu"), (True, "cuda:0")])
def test_without_a_wish_the_device_is_a_gpu_where_there_is_one(gpu, device, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: gpu)
    assert resolve_device(None) == device


def test_a_device_that_cannot_be_used_is_refused_with_what_to_do(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(UserError, match=r"--device cuda:1 .* no CUDA GPU .* --device cpu"):
        resolve_device("cuda:1")
    with pytest.raises(UserError, match=r"'gpu' is not a device. Use cpu, cuda"):
        resolve_device("gpu")


@pytest.mark.parametrize(
    "arguments",
    [["list_envs"], ["train", "--help"], ["play", "--help"], ["verify", "--help"]],
)
def test_what_only_answers_loads_nothing_heavy(arguments):
    code = (
        "import sys\n"
        f"sys.argv = {arguments!r}\n"
        f"from mjlab.scripts.{arguments[0]} import main\n"
        "try:\n    main()\nexcept SystemExit as ended:\n    assert ended.code == 0\n"
        "heavy = {'torch', 'mujoco', 'numpy', 'tyro', 'rich', 'yaml', 'rsl_rl'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    environment = {**os.environ, "PYTHONWARNINGS": "error"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr
