"""Outcomes of trials, whatever way they end."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
import time
from pathlib import Path

from .test_robustness import FAMILIES

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
