"""Completion of commands and task names by shells."""

from __future__ import annotations

import shutil
import subprocess
import sys

import pytest

from mjlab.cli.main import ALIASES, COMMANDS
from mjlab.scripts.completion import candidates
from mjlab.tasks.registry import list_tasks


def test_commands_come_first_then_tasks():
    assert set(candidates([""])) == {command.name for command in COMMANDS}
    assert candidates(["eva"]) == ["evaluate"]
    assert candidates(["train", "Mjlab-Cartpole-S"]) == ["Mjlab-Cartpole-Swingup"]
    assert candidates(["play", ""]) == list_tasks()
    assert candidates(["demo", ""]) == []
    assert candidates(["list-envs", "Mjlab-Cartpole-Swingup", "--num"]) == []
    assert candidates(["demo", "--po"]) == ["--port"]


@pytest.mark.parametrize(
    ("words", "completed"),
    [
        (["--num-e"], ["--num-envs"]),
        (["--agent.load"], ["--agent.load-run", "--agent.load-checkpoint"]),
        (["--video", "--hel"], ["--help"]),
        (["--help", "ag"], ["agent"]),
        (["--engine", ""], ["auto", "native", "warp"]),
        (["--profile", ""], ["cpu", "cpu-long"]),
    ],
)
def test_flags_and_their_values_are_completed(words, completed):
    assert candidates(["train", "Mjlab-Velocity-Flat-Unitree-Go1", *words]) == completed


@pytest.mark.parametrize(
    ("words", "completed"),
    [
        (["mjlab", "pl"], ["plot-seeds", "play"]),
        (["train", "Mjlab-Cartpole-S"], ["Mjlab-Cartpole-Swingup"]),
    ],
)
def test_bash_completes(words, completed):
    line = " ".join(words)
    script = f"""
mjlab() {{ {sys.executable} -m mjlab.cli.main "$@"; }}
eval "$(mjlab completion bash)"
COMP_WORDS=({line}); COMP_CWORD={len(words) - 1}
_mjlab_complete
printf '%s\\n' "${{COMPREPLY[@]}}"
complete -p {words[0]}
"""
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True)
    *found, registered = done.stdout.splitlines()
    assert found == completed
    assert registered.startswith("complete -o default -F _mjlab_complete")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_names_all_commands_and_is_valid(run, shell):
    outcome = run("completion", shell)
    assert outcome.status == 0
    assert all(name in outcome.out for name in ("mjlab", *ALIASES))
    if shutil.which(shell) is not None:
        subprocess.run([shell, "-n", "-c", outcome.out], check=True)


def test_another_shell_is_named(run):
    outcome = run("completion", "tcsh")
    assert outcome.status == 2
    assert "'tcsh'" in outcome.message
    assert "fish" in outcome.message
