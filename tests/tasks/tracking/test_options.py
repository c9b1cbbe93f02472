"""Selection of the motion: flags, Weights & Biases, the run of the policy, or the config."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from tracking_tasks import G1, part_of

from mjlab.tasks.registry import PolicyOrigin, load_env_cfg, load_options_cls
from mjlab.tasks.tracking import motion_sources as wandb_motions
from mjlab.tasks.tracking.motion_file import MotionFileError
from mjlab.tasks.tracking.motion_sources import find_motions, record_motions, shipped_motions
from mjlab.tasks.tracking.options import MotionOptions
from mjlab.utils.errors import UserError

SQUAT, WALK = (shipped_motions()[name] for name in ("squat", "slow_walk"))
CPU_ONLY = PolicyOrigin(G1)


def prepared(options: MotionOptions, origin: PolicyOrigin = CPU_ONLY, changed: str | None = None):
    """Return the motions that an environment is built with."""
    cfg = load_env_cfg(G1)
    if changed is not None:
        cfg.commands["motion"].motion_file = changed
    options.prepare(cfg, origin)
    return find_motions(cfg.commands["motion"].motion_file)


class Artifact:
    """An artifact of Weights & Biases that holds some files."""

    type = "motions"

    def __init__(self, folder: Path, *files: Path, name: str = "motion.npz"):
        self.name, self._folder = "squat:v3", folder
        folder.mkdir()
        for file in files:
            shutil.copyfile(file, folder / name)

    def download(self) -> str:
        return str(self._folder)


@pytest.fixture
def wandb(monkeypatch, tmp_path):
    """Stand in for Weights & Biases; `artifacts` and `runs` are what it has, by name."""
    stand_in = SimpleNamespace(artifacts={}, runs={}, asked=[])

    def found(kind):
        def find(name):
            stand_in.asked.append(name)
            if name not in kind:
                raise RuntimeError("404")
            return kind[name]

        return find

    api = SimpleNamespace(artifact=found(stand_in.artifacts), run=found(stand_in.runs))
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(Api=lambda: api))
    monkeypatch.setattr(wandb_motions.tempfile, "gettempdir", lambda: str(tmp_path))
    return stand_in


def a_run(*artifacts, files=()):
    return SimpleNamespace(files=lambda: list(files), used_artifacts=lambda: list(artifacts))


def uploaded(run_dir: Path, path: Path) -> SimpleNamespace:
    name = str(path.relative_to(run_dir))

    def download(folder: str, replace: bool) -> None:
        target = Path(folder) / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)

    return SimpleNamespace(name=name, download=download)


def test_the_tasks_bring_their_motion_themselves():
    assert load_options_cls(G1) is MotionOptions
    assert load_options_cls("Mjlab-Velocity-Flat-Unitree-G1") is None


def test_without_flags_it_is_what_ships_with_the_package():
    assert prepared(MotionOptions()) == [SQUAT, shipped_motions()["wave"]]


def test_a_motion_file_wins_over_everything(tmp_path):
    record_motions([SQUAT], tmp_path)
    origin = PolicyOrigin(G1, tmp_path / "model_0.pt")
    assert prepared(MotionOptions(motion_file="slow_walk"), origin, changed="wave") == [WALK]
    with pytest.raises(MotionFileError, match="motion 'walk.npz'"):
        prepared(MotionOptions(motion_file="walk.npz"))


def test_a_motion_that_was_changed_in_the_config_stays(tmp_path):
    record_motions([SQUAT], tmp_path)
    origin = PolicyOrigin(G1, tmp_path / "model_0.pt")
    assert prepared(MotionOptions(), origin, changed="slow_walk") == [WALK]


def test_a_policy_is_played_on_the_motions_that_its_run_recorded(tmp_path):
    own = part_of("wave", slice(0, 50), tmp_path / "own.npz")
    record_motions([own, SQUAT], tmp_path / "run")
    found = prepared(MotionOptions(), PolicyOrigin(G1, tmp_path / "run" / "model_9.pt"))
    assert [path.name for path in found] == ["own.npz", "squat.npz"]
    assert found[0].parent == tmp_path / "run" / "motion"


def test_recorded_motions_in_a_folder_with_a_comma_are_found(tmp_path):
    run = tmp_path / "run, the second"
    record_motions([WALK, SQUAT], run)
    found = prepared(MotionOptions(), PolicyOrigin(G1, run / "model_9.pt"))
    assert [path.name for path in found] == ["slow_walk.npz", "squat.npz"]


def test_a_run_that_recorded_none_is_told(tmp_path, caplog):
    prepared(MotionOptions(), PolicyOrigin(G1, tmp_path / "model_9.pt"))
    assert "no recorded motion; using squat,wave" in caplog.text


def test_an_artifact_of_the_registry_is_fetched_in_its_latest_version(wandb, tmp_path):
    wandb.artifacts["org/dances/squat:latest"] = Artifact(tmp_path / "a", SQUAT)
    wandb.artifacts["org/dances/squat:v1"] = Artifact(tmp_path / "b", WALK)
    (found,) = prepared(MotionOptions(registry_name="org/dances/squat"))
    assert found.read_bytes() == SQUAT.read_bytes()
    (found,) = prepared(MotionOptions(registry_name="org/dances/squat:v1"))
    assert found.read_bytes() == WALK.read_bytes()
    assert MotionOptions(registry_name="x").runner_kwargs() == {"registry_name": "x"}


def test_an_artifact_of_another_tool_has_its_motion_beside_other_files(wandb, tmp_path):
    artifact = wandb.artifacts["org/a:latest"] = Artifact(tmp_path / "a", SQUAT)
    shutil.copyfile(WALK, tmp_path / "a" / "contacts.npz")
    (found,) = prepared(MotionOptions(registry_name="org/a"))
    assert found.read_bytes() == SQUAT.read_bytes()
    (tmp_path / "a" / "motion.npz").rename(tmp_path / "a" / "dance.npz")
    names = [path.name for path in prepared(MotionOptions(registry_name="org/a"))]
    assert names == ["contacts.npz", "dance.npz"]
    assert artifact.type == "motions"


class CommError(Exception):
    """Error of wandb, with the response of the server below the message."""


@pytest.mark.parametrize(
    "error", [CommError("No API key.\n{...}"), KeyError(), TimeoutError("slow"), OSError("reset")]
)
def test_errors_of_wandb_name_the_request(wandb, monkeypatch, error):
    def api():
        raise error

    monkeypatch.setattr(sys.modules["wandb"], "Api", api)
    for options, origin, name in (
        (MotionOptions(registry_name="org/a"), CPU_ONLY, "Motion 'org/a:latest'"),
        (MotionOptions(), PolicyOrigin(G1, Path("m.pt"), "org/p/1"), "Run 'org/p/1'"),
    ):
        with pytest.raises(ConnectionError, match=f"^{name}: .*wandb login[^\n]*$"):
            prepared(options, origin)


@pytest.mark.parametrize(
    "path", ["org/p/..", "..", "../../x/..", "", "/", "org/p/..\\..\\x", "C:x"]
)
def test_runs_of_wandb_are_kept_in_their_folder(wandb, tmp_path, path):
    wandb.runs[path] = a_run(files=[listed("motion/motions.json")])
    with pytest.raises(UserError, match="mjlab-motions: expected the name of a file"):
        prepared(MotionOptions(), PolicyOrigin(G1, Path("m.pt"), path))
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize("name", ["motion/../../x", "motion//x", "motion/..\\..\\x", "motion/."])
def test_files_of_wandb_runs_are_kept_in_their_folder(wandb, tmp_path, name):
    wandb.runs["org/p/1"] = a_run(files=[listed("motion/motions.json"), listed(name)])
    with pytest.raises(UserError, match="expected the name of a file"):
        prepared(MotionOptions(), PolicyOrigin(G1, Path("m.pt"), "org/p/1"))
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []


def listed(name: str) -> SimpleNamespace:
    def download(folder: str, replace: bool) -> None:
        (Path(folder) / name).parent.mkdir(parents=True, exist_ok=True)
        (Path(folder) / name).write_text("[]")

    return SimpleNamespace(name=name, download=download)


def test_a_policy_of_wandb_comes_with_the_motion_that_its_run_used(wandb, tmp_path):
    model = SimpleNamespace(type="model", name="policy:v0")
    wandb.runs["org/p/1"] = a_run(model, Artifact(tmp_path / "a", SQUAT))
    (found,) = prepared(MotionOptions(), PolicyOrigin(G1, tmp_path / "model_9.pt", "org/p/1"))
    assert found.read_bytes() == SQUAT.read_bytes()


def test_a_policy_of_wandb_comes_with_the_motion_that_its_run_uploaded(wandb, tmp_path):
    run_dir = tmp_path / "run"
    paths = record_motions([WALK, SQUAT], run_dir)
    wandb.runs["org/p/2"] = a_run(files=[uploaded(run_dir, path) for path in paths])
    found = prepared(MotionOptions(), PolicyOrigin(G1, tmp_path / "model_9.pt", "org/p/2"))
    assert [path.name for path in found] == ["slow_walk.npz", "squat.npz"]
    assert found[0].read_bytes() == WALK.read_bytes()


@pytest.mark.parametrize(
    ("options", "origin", "message"),
    [
        (MotionOptions("squat", "org/a"), CPU_ONLY, "got both"),
        (
            MotionOptions(registry_name="org/none"),
            CPU_ONLY,
            "'org/none:latest'.*404",
        ),
        (
            MotionOptions(registry_name="org/empty"),
            CPU_ONLY,
            "'org/empty:latest': expected motions",
        ),
        (
            MotionOptions(),
            PolicyOrigin(G1, Path("m.pt"), "org/p/none"),
            "'org/p/none'",
        ),
        (
            MotionOptions(),
            PolicyOrigin(G1, Path("m.pt"), "org/p/bare"),
            "has neither.*--motion-file",
        ),
    ],
)
def test_what_is_not_there_is_told(wandb, tmp_path, options, origin, message):
    wandb.artifacts["org/empty:latest"] = Artifact(tmp_path / "empty")
    wandb.runs["org/p/bare"] = a_run()
    with pytest.raises((MotionFileError, ConnectionError), match=message):
        prepared(options, origin)


def test_a_missing_motion_without_a_record_is_named(tmp_path):
    origin = PolicyOrigin(G1, tmp_path / "model_0.pt")
    with pytest.raises(MotionFileError, match="gone.npz"):
        prepared(MotionOptions(), origin, changed="/elsewhere/gone.npz")
