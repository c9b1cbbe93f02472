"""`make reference` and `verify`: a reference is made once, and new seeds are compared with it."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from commands import run_script, stopped_after

from mjlab.cli.train_process import run_forwarding_signals
from mjlab.runs import Run
from mjlab.runs.reference import DATA, Reference, read_run, reference_path

ROOT = Path(__file__).resolve().parents[2]
TASK, OTHER = "Mjlab-Cartpole-Swingup", "Mjlab-Cartpole-Balance"
TINY = (
    "--num-envs", "8", "--agent.num-steps-per-env", "4", "--agent.max-iterations", "4",
    "--agent.save-interval", "1", "--agent.evaluation.min-interval", "1",
    "--agent.evaluation.num-episodes", "4", "--env.episode-length-s", "0.1",
)  # fmt: skip
ITERATIONS = 4


class Maker:
    """`benchmarks/reference.py`, with its commands run in this process for speed."""

    def __init__(self, module: ModuleType, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.module, self.folder, self.monkeypatch = module, folder, monkeypatch
        self.trained: list[list[str]] = []
        self.commit("first")
        monkeypatch.setattr(module, "run_forwarding_signals", self._train)
        monkeypatch.setattr(module, "output_of", self._output_of)

    def commit(self, name: str) -> None:
        self.monkeypatch.setattr(self.module, "code_commit", lambda: name)

    def _train(self, command: list[str], seconds: float) -> tuple[int, bool]:
        self.trained.append(command[3:])
        # In this process, no time limit would be noticed.
        if seconds < 1.0:
            with stopped_after(2):
                return run_script("train", *command[3:]).status, False
        return run_script("train", *command[3:]).status, False

    def _output_of(self, command: list[str]) -> str:
        outcome = run_script(command[2].rpartition(".")[2], *command[3:])
        assert outcome.status == 0, outcome.err
        return outcome.out

    def options(self, **changes: Any) -> Any:
        return self.module.Options(**{
            "minutes": 60.0, "flags": [*TINY], "episodes": 4, "device": "cpu", "again": False,
            "data": self.folder / "data", "pages": self.folder / "pages",
            "log_root": self.folder / "logs", **changes,
        })  # fmt: skip

    def make(self, *tasks: str, seeds: int = 3, **changes: Any) -> bool:
        options = self.options(**changes)
        return all(self.module.make(task, seeds, options) for task in tasks or (TASK,))

    @property
    def path(self) -> Path:
        return reference_path(self.folder / "data", TASK, "cpu")

    @property
    def reference(self) -> Reference:
        return Reference.load(self.path)


@pytest.fixture(scope="module")
def module() -> ModuleType:
    """Return `benchmarks/reference.py`."""
    with pytest.MonkeyPatch.context() as patch:
        # The benchmarks have another module of this name.
        patch.delitem(sys.modules, "commands")
        patch.syspath_prepend(ROOT / "benchmarks")
        return importlib.import_module("reference")


@pytest.fixture(scope="module")
def made(module, tmp_path_factory) -> Path:
    """Return the folder of a reference of three seeds; not to be changed."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        maker = Maker(module, tmp_path_factory.mktemp("made"), monkeypatch)
        assert maker.make()
        return maker.folder


@pytest.fixture
def maker(module, made, tmp_path, monkeypatch) -> Maker:
    """Return a maker that has the three seeds already."""
    return Maker(module, shutil.copytree(made, tmp_path / "made"), monkeypatch)


@pytest.fixture
def empty(module, tmp_path, monkeypatch) -> Maker:
    """Return a maker that has nothing yet."""
    return Maker(module, tmp_path / "empty", monkeypatch)


@pytest.fixture
def verify(run, made, tmp_path):
    """Return a function that runs `verify` with the reference of `made`, or an edited one."""

    def verify(*flags: str, edit=None):
        path = tmp_path / "reference.json"
        content = json.loads(reference_path(made / "data", TASK, "cpu").read_text())
        if edit is not None:
            edit(content)
        path.write_text(json.dumps(content))
        own = ("--reference", str(path), "--log-root", str(tmp_path / "logs"), "--device", "cpu")
        return run("verify", TASK, *own, *flags)

    return verify


def raise_returns(reference: dict, by: float = 900.0) -> None:
    """Let the reference be of a task with much higher returns."""
    for seed in reference["seeds"]:
        figures = seed["run"]["figures"]
        figures["mean_return"] = [value + by for value in figures["mean_return"]]


# verify


def test_a_seed_like_those_of_the_reference_is_within(verify, tmp_path):
    outcome = verify()
    assert outcome.status == 0, outcome.err
    assert "Verdict    within: 100% of the way" in outcome.out
    assert "steps/s (collecting and learning); reference" in outcome.out
    (run_dir,) = (tmp_path / "logs" / "cartpole").iterdir()
    assert run_dir.name.endswith("_verify_seed_0")
    assert (run_dir / "verify.png").read_bytes().startswith(b"\x89PNG")
    # As the reference was trained, with another seed.
    run = read_run(run_dir)
    assert (run.iterations, run.samples_at) == (ITERATIONS, [32, 64, 96, 128])


def test_a_curve_outside_is_told_by_the_exit_status(verify):
    outcome = verify("--seed", "9", edit=raise_returns)
    assert outcome.status == 1
    assert "Verdict    OUTSIDE: 0% of the way within the band, its end outside" in outcome.out
    assert "error" not in outcome.err


def test_training_ends_where_the_shortest_run_of_the_reference_did(verify, tmp_path):
    def shorten(reference: dict) -> None:
        for seed, iterations in zip(reference["seeds"], (4, 2, 3), strict=True):
            seed["run"]["iterations"] = iterations
        # The shortest one ended an iteration after its last evaluation.
        shortest = reference["seeds"][1]["run"]
        shortest["iterations"], shortest["samples"] = 3, shortest["samples"] * 3 // 2

    assert verify(edit=shorten).status == 0
    (run_dir,) = (tmp_path / "logs" / "cartpole").iterdir()
    assert Run(run_dir).info["iterations"] == 2


@pytest.mark.slow
def test_where_all_seeds_were_solved_one_that_is_not_in_time_is_outside(verify, tmp_path):
    def solve(reference: dict) -> None:
        for seed in reference["seeds"]:
            seed["run"]["ended"] = "solved"

    outcome = verify(edit=solve)
    assert outcome.status == 1
    assert "Solved     not; reference after 128, a healthy seed within" in outcome.out
    assert "the samples until it is solved outside" in outcome.out
    (run_dir,) = (tmp_path / "logs" / "cartpole").iterdir()
    assert ITERATIONS < Run(run_dir).info["iterations"] <= 4 * ITERATIONS


@pytest.mark.slow
def test_with_one_solved_seed_only_being_solved_counts(verify):
    def solve(reference: dict) -> None:
        raise_returns(reference)
        one_seed(reference)
        reference["seeds"][0]["run"]["ended"] = "solved"

    outcome = verify(edit=solve)
    assert outcome.status == 1
    assert "Verdict    OUTSIDE: the samples until it is solved outside" in outcome.out
    assert "inf" not in outcome.out


def test_with_one_unsolved_seed_the_end_counts(verify):
    def raised_by(returns: float) -> Callable[[dict], None]:
        def edit(reference: dict) -> None:
            raise_returns(reference, returns)
            one_seed(reference)

        return edit

    outcome = verify(edit=raised_by(900.0))
    assert outcome.status == 1
    assert (
        "Verdict    OUTSIDE: its end outside. The reference has fewer than three seeds"
        in outcome.out
    )
    assert "a healthy seed has a mean return of" in outcome.out
    assert "inf" not in outcome.out
    assert verify("--resume", edit=raised_by(-900.0)).status == 0


@pytest.mark.slow
def test_an_interrupted_run_is_kept_and_goes_on(verify, tmp_path, monkeypatch):
    with stopped_after(2):
        outcome = verify("--seed", "5")
    assert outcome.status == 130
    assert "So far     100% of the way within the band" in outcome.out
    assert "Verdict" not in outcome.out
    resumed = verify("--seed", "5", "--resume")
    assert resumed.status == 0, resumed.err
    newest = max((tmp_path / "logs" / "cartpole").iterdir())
    figures = read_run(newest).figures
    # An earlier session that is gone is a bad call, not a curve that is outside.
    first = min((tmp_path / "logs" / "cartpole").iterdir())
    first.rename(tmp_path / "away")
    lost = verify("--seed", "5", "--resume")
    assert lost.status == 2
    assert "earlier session" in lost.message
    (tmp_path / "away").rename(first)
    # A finished run is compared again, without training.
    again = verify("--seed", "5", "--resume", edit=raise_returns)
    assert again.status == 1
    assert "Finished" not in again.out
    shutil.rmtree(tmp_path / "logs")
    assert verify("--seed", "5").status == 0
    (uninterrupted,) = (tmp_path / "logs" / "cartpole").iterdir()
    assert read_run(uninterrupted).figures == figures


@pytest.mark.slow
def test_a_run_interrupted_before_its_first_evaluation_goes_on(verify):
    late = ["--agent.evaluation.min-interval", "3"]
    with stopped_after(2):
        outcome = verify("--seed", "5", edit=lambda reference: reference["flags"].extend(late))
    assert outcome.status == 130
    assert "no evaluation: the same command with --resume" in outcome.out
    assert verify("--seed", "5", "--resume").status == 0


@pytest.mark.slow
def test_a_run_interrupted_in_its_last_iteration_has_finished(verify):
    with stopped_after(ITERATIONS):
        outcome = verify("--seed", "5")
    assert outcome.status in (0, 1)
    assert "Verdict" in outcome.out


def one_seed(reference: dict) -> None:
    del reference["seeds"][1:]


@pytest.mark.parametrize(
    ("flags", "edit", "named"),
    [
        (("--resume",), None, "expected a run of `verify"),
        (("--device", "gpu"), None, "got 'gpu'"),
        ((), lambda reference: reference.update(seeds=[]), "expected one seed or more, got none"),
        (
            (),
            lambda reference: reference.update(teacher=["A", "--x"]),
            "run of `uv run mjlab train A",
        ),
        ((), lambda reference: reference.update(task=OTHER), f"got {OTHER}"),
        ((), lambda reference: reference.update(profile="none-such"), "profile 'none-such'"),
        ((), lambda reference: reference.pop("flags"), "expected a reference"),
    ],
)
def test_a_bad_call_ends_with_2_before_anything_is_trained(verify, tmp_path, flags, edit, named):
    outcome = verify(*flags, edit=edit)
    assert outcome.status == 2
    assert named in outcome.message
    assert not (tmp_path / "logs").exists()


def test_an_unknown_task_or_flag_ends_with_2(run, verify):
    assert run("verify", "Mjlab-Cartpole-Swing").status == 2
    assert verify("--num-envs", "3").status == 2


@pytest.mark.parametrize(
    ("task", "names"),
    [
        (OTHER, (f"got '{OTHER}'", f"Available: B (gpu), {TASK} (cpu, gpu)", f"TASKS={OTHER}`")),
        (TASK, (f"a reference of {TASK} on this kind of device, gpu", "use --device cpu")),
    ],
)
def test_without_a_reference_those_there_are_and_how_to_make_one_is_told(
    run, tmp_path, monkeypatch, task, names
):
    for stem in ("B.gpu", f"{TASK}.cpu", *([f"{TASK}.gpu"] if task == OTHER else [])):
        (tmp_path / f"{stem}.json").write_text("{}")
    monkeypatch.setattr("mjlab.scripts.verify.DATA", tmp_path)
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    outcome = run("verify", task)
    assert outcome.status == 2
    for name in names:
        assert name in outcome.message


def test_references_that_ship_can_be_read():
    for path in DATA.glob("*.json"):
        reference = Reference.load(path)
        assert path == reference_path(DATA, reference.task, reference.kind)


def test_references_that_ship_can_be_continued(module, maker):
    for path in DATA.glob("*.json"):
        reference = Reference.load(path)
        options = maker.options(flags=[], data=DATA)
        assert module._reference(reference.task, options) == reference


# make reference


def test_what_is_finished_is_kept_and_more_seeds_are_added(maker, capsys):
    before = maker.path.read_bytes()
    assert maker.make()
    assert not maker.trained
    assert maker.path.read_bytes() == before
    maker.commit("second")
    assert maker.make(seeds=4)
    assert [record.commit for record in maker.reference.seeds] == ["first"] * 3 + ["second"]
    assert "seed 3: kept, of commit first" in capsys.readouterr().out


def test_a_record_says_how_it_was_made(made):
    (first, *_) = seeds = Reference.load(reference_path(made / "data", TASK, "cpu")).seeds
    assert [record.seed for record in seeds] == [1, 2, 3]
    assert first.commit == "first"
    assert first.machine.keys() == {"cores", "processor", "gpu"}
    assert first.versions.keys() == {"mjlab", "mujoco", "torch", "rsl-rl-lib"}
    assert (first.run.ended, first.run.iterations) == ("finished", ITERATIONS)
    # Evaluated on the training config, with seeds not used for training.
    assert first.evaluation["mean_length"] == 2.0
    assert {record.evaluation["seed"] for record in seeds} == {1001, 1002, 1003}
    assert str(made) not in json.dumps(first.evaluation)


def test_settings_of_references_are_of_stock_tasks(module):
    assert {*module.SEEDS, *module.EVALUATION_FLAGS, *module.CLIPS} <= set(module.stock_tasks())


def test_the_page_shows_what_was_run(made, module):
    text = (made / "pages" / "index.md").read_text()
    rows = {row[0]: row for line in text.splitlines() if (row := _cells(line))}
    assert {row.strip("[").partition("]")[0] for row in rows if "Mjlab" in row} == set(
        module.stock_tasks()
    )
    assert rows[OTHER][1:] == ["not run", "", "", "not run", "", ""]
    swing_up = rows[f"[{TASK}](#{TASK.lower()})"]
    assert swing_up[3].startswith("0 of 3 solved; return ")
    assert swing_up[4] == "not run"
    assert f"![Curves of {TASK}]({TASK}.png)" in text
    picture = (made / "pages" / f"{TASK}.png").read_bytes()
    assert picture.startswith(b"\x89PNG")


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("| ") else []


def test_the_page_of_the_documentation_is_that_of_the_data(module):
    assert (ROOT / "docs" / "reference" / "runs" / "index.md").read_text() == module.page(DATA)


@pytest.mark.slow
def test_only_what_is_asked_for_is_replaced(maker):
    before = {record.seed: record for record in maker.reference.seeds}
    maker.commit("second")
    assert maker.make(seeds=1, again=True)
    after = {record.seed: record for record in maker.reference.seeds}
    assert [after[seed].commit for seed in (1, 2, 3)] == ["second", "first", "first"]
    assert (after[2], after[3]) == (before[2], before[3])
    assert after[1].run.figures == before[1].run.figures
    # The same once more finds it done.
    maker.trained.clear()
    assert maker.make(seeds=1, again=True)
    assert not maker.trained


@pytest.mark.slow
def test_students_have_one_teacher_which_is_trained_first(empty, monkeypatch):
    student, count = "Mjlab-Lift-Cube-Yam-Depth", 2
    task = "Mjlab-Lift-Cube-Yam"
    monkeypatch.setattr(empty.module, "TEACHER", [task, "--profile", "cpu", *TINY])
    flags = [*TINY, "--agent.evaluation.first-iteration", "0"]
    assert empty.make(student, seeds=count, flags=flags)
    (teacher, *students) = empty.trained
    assert teacher[0] == task
    assert [command[0] for command in students] == [student] * count
    (teacher_run,) = (empty.folder / "logs" / "cpu" / "teacher").glob("*/*/")
    assert all(f"{Run(teacher_run).newest}" in command for command in students)
    reference = Reference.load(reference_path(empty.folder / "data", student, "cpu"))
    assert str(empty.folder) not in " ".join(reference.flags)
    page = (empty.folder / "pages" / "index.md").read_text()
    assert f"{student} --profile student" in page
    assert "--agent.teacher-checkpoint RUN" in page


@pytest.mark.slow
def test_a_seed_whose_time_is_over_is_reported_and_goes_on_with_more_time(empty, made):
    assert empty.make(seeds=1, minutes=1e-3)
    (record,) = empty.reference.seeds
    assert (record.run.ended, record.run.iterations) == ("minutes", 2)
    assert empty.make(seeds=1, minutes=1e-3)
    assert len(empty.trained) == 1
    assert empty.make(seeds=1)
    (record,) = empty.reference.seeds
    assert "--agent.resume" in empty.trained[-1]
    whole = Reference.load(reference_path(made / "data", TASK, "cpu")).seeds[0]
    assert record.run.figures == whole.run.figures
    assert record.run.samples_at == whole.run.samples_at
    assert record.evaluation["mean_return"] == whole.evaluation["mean_return"]


@pytest.mark.slow
@pytest.mark.parametrize("first_evaluation", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_ctrl_c_ends_the_series_and_the_seed_is_resumed(empty, monkeypatch, first_evaluation):
    flags = [*TINY, "--agent.evaluation.min-interval", str(first_evaluation)]

    def interrupted(command, seconds):
        with stopped_after(2):
            run_script("train", *command[3:])
        return 0, True

    with monkeypatch.context() as patch:
        patch.setattr(empty.module, "run_forwarding_signals", interrupted)
        assert not empty.make(seeds=2, flags=flags)
    assert not empty.path.exists()
    assert empty.make(seeds=1, flags=flags)
    (command,) = empty.trained
    assert "--agent.resume" in command
    assert empty.reference.seeds[0].run.ended == "finished"


@pytest.mark.slow
def test_an_interrupted_seed_of_other_code_is_trained_from_the_start(empty, monkeypatch):
    assert empty.make(seeds=1, minutes=1e-3)
    empty.commit("second")
    assert empty.make(seeds=1)
    assert "--agent.resume" not in empty.trained[-1]
    assert empty.reference.seeds[0].commit == "second"


@pytest.mark.slow
def test_seeds_with_other_flags_are_not_mixed(maker):
    flags = [*TINY, "--agent.algorithm.learning-rate", "0.1"]
    with pytest.raises(Exception, match="use AGAIN=1 to replace all"):
        maker.make(flags=flags)
    assert maker.make(seeds=1, flags=flags, again=True)
    assert len(maker.reference.seeds) == 1


def test_a_task_that_fails_is_named(empty):
    with pytest.raises(RuntimeError, match=f"Training of {TASK}, seed 1, ended with status 2"):
        empty.make(seeds=1, flags=["--no-such-flag"])


def test_a_command_gets_a_signal_when_its_time_is_over():
    child = (
        "import signal, sys, time\n"
        "signal.signal(signal.SIGINT, lambda *_: sys.exit(7))\n"
        "time.sleep(30)\n"
    )
    begin = time.monotonic()
    status, stopped = run_forwarding_signals([sys.executable, "-c", child], 1.0)
    assert (status, stopped) == (7, None)
    assert time.monotonic() - begin < 20


def test_the_makefile_passes_its_limits_on():
    command = ["make", "-n", "reference", f"TASKS={TASK}", "SEEDS=5", "MINUTES=2", "AGAIN=1"]
    # An outer `make test` passes on its flags, so that make prints each folder.
    ours = {"DEVICE", "MAKEFLAGS", "MAKELEVEL", "MFLAGS"}
    environment = {k: v for k, v in os.environ.items() if k not in ours}
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=True, env=environment
    )
    flags = done.stdout.replace("\\\n", " ").split("benchmarks/reference.py")[1].split()
    assert flags == ["--tasks", TASK, "--seeds", "5", "--minutes", "2", "--again"]
