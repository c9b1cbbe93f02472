"""Outcomes of trials, whatever way they end."""

from __future__ import annotations

import importlib
import json
import random
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch

from . import damage
from .commands import Ended, check_end
from .runs import same
from .test_robustness import FAMILIES
from .trials import Broken, Result, Trial, Verdict, table

# Trials that end in every way there is. Run apart, because processes are forked.
STUB = """
import json, os, signal, subprocess, sys, time
from pathlib import Path
from types import SimpleNamespace
from robustness.trials import Broken, run_trials

def run(trial, prepared):
    trial.trying(f"trial {trial.number} of {prepared}")
    if trial.number == 1:
        raise Broken("as expected")
    if trial.number == 2:
        {}["key"]
    if trial.number == 3:
        time.sleep(60)
    if trial.number == 4:
        os.kill(os.getpid(), signal.SIGSEGV)
    if trial.number == 5:
        child = subprocess.Popen(["sleep", "60"], start_new_session=True)
        Path("../../../../../child").write_text(str(child.pid))
    if trial.number == 6:
        trial.notes.append("seen")
    Path("file").write_text("")

folder = Path(sys.argv[1])
stub = SimpleNamespace(__name__="stub", LIMIT=4.0, prepare=lambda folder: "seven", run=run)
verdicts = {v.number: (v.what, v.broken, v.notes) for v in run_trials("stub", stub, range(7), 0, folder)}
print(json.dumps([verdicts[number] for number in range(7)]))
"""


def test_trials_that_fail_hang_crash_or_leave_processes_are_told(tmp_path: Path) -> None:
    folder = tmp_path / "stub"
    folder.mkdir()
    begin = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", STUB, str(folder)],
        env={"PYTHONPATH": str(Path(__file__).parents[1]), "PATH": "/usr/bin:/bin"},
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert time.monotonic() - begin < 40
    verdicts = json.loads(done.stdout)
    assert [what for what, _, _ in verdicts] == [f"trial {k} of seven" for k in range(7)]
    held, broken, raised, hung, crashed, left, noted = (reason for _, reason, _ in verdicts)
    assert held is noted is None
    assert verdicts[6][2] == ["seen"]
    assert broken == "as expected"
    assert "KeyError" in raised
    assert "no end after 4 s" in hung
    assert "-11" in crashed
    assert "1 processes running: sleep" in left
    # Processes that a trial started end with it, and its files are gone.
    assert not Path("/proc", (folder / "child").read_text()).exists()
    assert not list(folder.glob("trial_*"))


def test_a_trial_follows_from_family_number_and_seed(tmp_path: Path) -> None:
    draws = {
        key: Trial(*key, tmp_path).rng.random()
        for key in (("page", 3, 0), ("page", 4, 0), ("page", 3, 1), ("kills", 3, 0))
    }
    assert len(set(draws.values())) == 4
    assert Trial("page", 3, 0, tmp_path).rng.random() == draws["page", 3, 0]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({}, None),
        ({"status": 1, "err": "error: expected 1, got 2"}, None),
        ({"status": 1}, "without a word"),
        (
            {"status": 1, "err": "Traceback (most recent call last):\n  x\nKeyError: 'a'"},
            "KeyError",
        ),
        ({"status": -11}, "SIGSEGV"),
        ({"status": 120, "err": "lost"}, "120"),
        ({"stuck": "deaf to Ctrl-C"}, "deaf"),
        ({"size": 10_000_000}, "10,000,000"),
    ],
)
def test_a_command_ends_well_or_says_why_not(changes: dict[str, Any], reason: str | None) -> None:
    usual: dict[str, Any] = {"status": 0, "out": "", "err": "", "size": 0, "stuck": None}
    ended = Ended(**{**usual, **changes}, was_asked=False)
    if reason is None:
        check_end(ended)
        return
    with pytest.raises(Broken, match=reason):
        check_end(ended)


def test_damages_change_a_file_and_repeat() -> None:
    data = random.Random(0).randbytes(500)
    for apply in set(damage._DAMAGES):
        first, again = (apply(data, random.Random(5)) for _ in range(2))
        assert first == again
        assert first[0] != data, apply
    flipped, _ = damage._flip(data, random.Random(1))
    differing = [(a ^ b).bit_count() for a, b in zip(data, flipped, strict=True)]
    assert sum(differing) == 1


def test_contents_are_compared_to_the_bit() -> None:
    nan = torch.tensor([float("nan")])
    assert same({"a": [nan, float("nan")]}, {"a": [nan.clone(), float("nan")]})
    assert not same(torch.tensor([0.0]), torch.tensor([-0.0]))
    assert not same({"a": 1}, {"a": True})
    assert not same([1], [1, 2])


def test_the_table_counts_failures() -> None:
    broken = Verdict("page", 7, "odd bytes", "it\nended")
    result = Result("page", 3.0, 12, [broken])
    result.notes["seen"] = 2
    text = table([result], seed=5)
    assert "| page | 12 | 11 | 1 |" in text
    assert "| all | 12 | 11 | 1 |" in text
    assert "odd bytes: it ended (`make torture PARTS=page SEED=5 TRIAL=7`)" in text
    assert "seen (2 times)" in text


def test_every_family_is_registered() -> None:
    modules = {path.stem for path in Path(__file__).parent.glob("*.py")}
    helpers = {"commands", "conftest", "runs", "trials", "test_robustness", "test_trials"}
    assert modules - helpers == set(FAMILIES)


def test_every_family_is_in_the_readme_with_its_trials() -> None:
    text = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (\d+) \|", text, re.MULTILINE)
    trials = {name: importlib.import_module(f".{name}", __package__).TRIALS for name in FAMILIES}
    assert {name: int(number) for name, number in rows} == trials
    assert len(rows) == len(trials)
