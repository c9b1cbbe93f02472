"""YAML of configs, and the search for checkpoints."""

from __future__ import annotations

import enum
import math
import os
import stat
import subprocess
import sys
import types
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import yaml

from mjlab.utils.errors import UserError
from mjlab.utils.os import (
    dump_yaml,
    get_checkpoint_path,
    get_wandb_checkpoint_path,
    inside,
    own_folder,
    remove_temporary_files,
    replacing,
    temporary_path,
)


class Color(enum.IntEnum):
    RED = 1


@dataclass
class Inner:
    func: object = math.sqrt
    limits: tuple[float, float] = (-math.inf, 1e-5)


@dataclass
class Outer:
    inner: Inner = field(default_factory=Inner)
    again: Inner | None = None
    color: Color = Color.RED
    by_color: dict = field(default_factory=lambda: {Color.RED: (1, 2)})
    values: object = None


def _dumped(tmp_path: Path, data: object) -> dict:
    dump_yaml(tmp_path / "out.yaml", {"data": data})
    return yaml.safe_load((tmp_path / "out.yaml").read_text())["data"]


def test_configs_become_plain_yaml(tmp_path):
    inner = Inner()
    loaded = _dumped(tmp_path, Outer(inner=inner, again=inner))
    plain = {"func": "math:sqrt", "limits": [-math.inf, 1e-5]}
    assert loaded["inner"] == loaded["again"] == plain
    assert loaded["color"] == "RED"
    assert loaded["by_color"] == {"RED": [1, 2]}
    text = (tmp_path / "out.yaml").read_text()
    assert "!" not in text
    assert "&" not in text


def test_a_lambda_is_named_by_its_place(tmp_path):
    assert _dumped(tmp_path, lambda: 0).endswith("<lambda>")


def test_what_contains_itself_ends(tmp_path):
    data = {"a": 1}
    data["self"] = data
    assert _dumped(tmp_path, data)["self"] == "<contains itself>"


def test_suffix_and_folders_are_added_and_order_is_kept(tmp_path):
    dump_yaml(tmp_path / "x" / "params" / "env.v1", {"b": 1, "a": 2})
    text = (tmp_path / "x" / "params" / "env.v1.yaml").read_text()
    assert text == "b: 1\na: 2\n"
    dump_yaml(tmp_path / "sorted", {"b": 1, "a": 2}, sort_keys=True)
    assert (tmp_path / "sorted.yaml").read_text() == "a: 2\nb: 1\n"


def test_a_failing_write_leaves_the_previous_file(tmp_path, monkeypatch):
    dump_yaml(tmp_path / "a.yaml", {"old": 1})

    def full_disk(source, target):
        raise OSError("No space left on device")

    monkeypatch.setattr(os, "replace", full_disk)
    with pytest.raises(OSError, match="No space"):
        dump_yaml(tmp_path / "a.yaml", {"new": 2})
    monkeypatch.undo()
    assert os.listdir(tmp_path) == ["a.yaml"]
    assert yaml.safe_load((tmp_path / "a.yaml").read_text()) == {"old": 1}


def _make_run(root: Path, name: str, *files: str) -> None:
    (root / name).mkdir(parents=True)
    for file in files:
        (root / name / file).touch()


def test_the_newest_run_and_the_highest_iteration_are_taken(tmp_path):
    _make_run(tmp_path, "2025-01-01", "model_5.pt")
    _make_run(tmp_path, "2025-01-02", "model_9.pt", "model_100.pt")
    _make_run(tmp_path, "wandb_checkpoints", "model_7.pt")
    assert get_checkpoint_path(tmp_path) == tmp_path / "2025-01-02" / "model_100.pt"
    older = get_checkpoint_path(tmp_path, run_dir="2025-01-01")
    assert older == tmp_path / "2025-01-01" / "model_5.pt"


def test_a_half_written_file_is_no_checkpoint(tmp_path):
    _make_run(tmp_path, "run", "model_1.pt", "model_2.pt.tmp")
    assert get_checkpoint_path(tmp_path, checkpoint=r"model_.*\.pt").name == "model_1.pt"
    _make_run(tmp_path, "run_without", "model_3.pt.tmp")
    assert get_checkpoint_path(tmp_path, checkpoint=r"model_.*\.pt").name == "model_1.pt"


def test_event_files_do_not_hide_checkpoints(tmp_path):
    _make_run(tmp_path, "run", "model_1.pt", "events.out.tfevents.1700000000")
    assert get_checkpoint_path(tmp_path).name == "model_1.pt"


def test_runs_without_a_checkpoint_are_passed_over(tmp_path):
    _make_run(tmp_path, "a", "model_1.pt")
    _make_run(tmp_path, "b")
    assert get_checkpoint_path(tmp_path, checkpoint="model_.*").parent.name == "a"


def test_a_run_named_in_full_goes_before_those_it_is_the_start_of(tmp_path):
    _make_run(tmp_path, "2025", "model_1.pt")
    _make_run(tmp_path, "2025_test", "model_1.pt")
    assert get_checkpoint_path(tmp_path, run_dir="2025").parent.name == "2025"
    assert get_checkpoint_path(tmp_path, run_dir="202").parent.name == "2025_test"


def test_runs_can_be_sorted_by_time(tmp_path):
    _make_run(tmp_path, "b", "model_1.pt")
    _make_run(tmp_path, "a", "model_1.pt")
    os.utime(tmp_path / "b", (1, 1))
    assert get_checkpoint_path(tmp_path, sort_alpha=False).parent.name == "a"
    assert get_checkpoint_path(tmp_path).parent.name == "b"


def test_what_is_missing_is_named(tmp_path):
    with pytest.raises(ValueError, match="Log folder .*nowhere"):
        get_checkpoint_path(tmp_path / "nowhere")
    _make_run(tmp_path, "first")
    with pytest.raises(ValueError, match=r"matches 'second'.*\['first'\]"):
        get_checkpoint_path(tmp_path, run_dir="second")
    with pytest.raises(ValueError, match=r"'model_3.pt' in the runs \['first'\]"):
        get_checkpoint_path(tmp_path, checkpoint="model_3.pt")


class FakeWandbFile:
    def __init__(self, name: str, fails: bool = False) -> None:
        self.name = name
        self.fails = fails

    def download(self, root: str, replace: bool = False) -> None:
        (Path(root) / self.name).write_text(self.name)
        if self.fails:
            raise ConnectionError


@pytest.fixture
def wandb_files(monkeypatch):
    """The files of the only run of a made-up server; without it, asking the server fails."""
    names = ["model_50.pt", "model_400.pt", "model_x.pt", "config.yaml"]
    files = {name: FakeWandbFile(name) for name in names}
    config = {"env_cfg": {"decimation": 2}, "train_cfg": {"seed": 7}, "note": "..."}
    run = types.SimpleNamespace(
        files=lambda: list(files.values()), file=files.__getitem__, config=config
    )
    api = types.SimpleNamespace(run={"me/project/abc": run}.__getitem__)
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    monkeypatch.setitem(sys.modules, "wandb", types.SimpleNamespace(Api=lambda: api))
    return files


class UsageError(Exception):
    """As wandb calls it."""


@pytest.mark.parametrize("error", [UsageError("No key.\nTraceback: ..."), OSError("No key")])
def test_errors_of_wandb_name_the_run(tmp_path, monkeypatch, error):
    def fail():
        raise error

    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    monkeypatch.setitem(sys.modules, "wandb", types.SimpleNamespace(Api=fail))
    with pytest.raises(ConnectionError, match=r"'me/project/abc'.*No key.*wandb login"):
        get_wandb_checkpoint_path(tmp_path, Path("me/project/abc"))
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ConnectionError, match=r"'me/project/abc'.*wandb"):
        get_wandb_checkpoint_path(tmp_path, Path("me/project/abc"))


@pytest.mark.parametrize("path", ["me/p/..", "..", "../../..", "", "/", "me/..\\..\\x", "me/p/C:x"])
def test_run_paths_stay_in_the_cache(tmp_path, wandb_files, path):
    log_path = tmp_path / "logs" / "cartpole"
    with pytest.raises(UserError, match="wandb_checkpoints: expected the name of a file"):
        get_wandb_checkpoint_path(log_path, Path(path), "model_50.pt")
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize(
    "name", ["../model_50.pt", "model_50.pt/../x.pt", "/tmp/model_50.pt", "", ".."]
)
def test_checkpoint_names_stay_in_the_cache(tmp_path, wandb_files, name):
    with pytest.raises(ValueError, match="not found"):
        get_wandb_checkpoint_path(tmp_path, Path("me/project/abc"), name)
    assert [*tmp_path.iterdir()] == []


def test_names_inside_a_folder(tmp_path):
    for name in ("a", "a/b.npz", "..a", "%2e%2e", "ab:c"):
        assert inside(tmp_path, name) == tmp_path / name
    for name in ("", ".", "..", "/a", "a/", "a//b", "a/../b", "\\a", "a\\..\\b", "C:\\a", "C:"):
        with pytest.raises(UserError, match="expected the name"):
            inside(tmp_path, name)


def test_the_highest_wandb_checkpoint_is_downloaded_once(tmp_path, wandb_files):
    path, was_cached = get_wandb_checkpoint_path(tmp_path, Path("me/project/abc"))
    assert (path, was_cached) == (tmp_path / "wandb_checkpoints" / "abc" / "model_400.pt", False)
    assert path.read_text() == "model_400.pt"
    assert get_wandb_checkpoint_path(tmp_path, Path("me/project/abc")) == (path, True)
    params = {p.name: p.read_text() for p in (path.parent / "params").iterdir()}
    assert params == {"env.yaml": "decimation: 2\n", "agent.yaml": "seed: 7\n"}
    # Asked for by name, a cached file needs no server.
    wandb_files.clear()
    assert get_wandb_checkpoint_path(tmp_path, Path("me/project/abc"), path.name) == (path, True)


def test_a_named_wandb_checkpoint_must_exist(tmp_path, wandb_files):
    path, _ = get_wandb_checkpoint_path(tmp_path, Path("me/project/abc"), "model_50.pt")
    assert path.name == "model_50.pt"
    with pytest.raises(ValueError, match=r"'model_7.pt'.*\['model_50.pt', 'model_400.pt'\]"):
        get_wandb_checkpoint_path(tmp_path, Path("me/project/abc"), "model_7.pt")


def test_a_broken_download_is_not_cached(tmp_path, wandb_files):
    wandb_files["model_400.pt"].fails = True
    with pytest.raises(ConnectionError):
        get_wandb_checkpoint_path(tmp_path, Path("me/project/abc"))
    assert list((tmp_path / "wandb_checkpoints" / "abc").glob("*.pt")) == []


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_a_replaced_file_has_the_permissions_that_the_umask_leaves(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        with replacing(tmp_path / "file") as file:
            file.write(b"new")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == mode
    assert os.listdir(tmp_path) == ["file"]


def test_a_replaced_file_is_the_old_one_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt), replacing(path) as file:
        file.write(b"ne")
        file.flush()
        assert path.read_bytes() == b"old"
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["file"]


def test_a_full_disk_is_an_error_that_names_the_file(tmp_path):
    with (
        pytest.raises(OSError, match=r"full.*result\.npz") as found,
        replacing(tmp_path / "result.npz"),
    ):
        raise OSError(28, "full")
    assert found.value.errno == 28
    with pytest.raises(OSError, match="^own words$"), replacing(tmp_path / "result.npz"):
        raise OSError("own words")
    with pytest.raises(FileNotFoundError, match="other"), replacing(tmp_path / "result.npz"):
        (tmp_path / "other").read_bytes()


def test_a_link_is_replaced_and_not_followed(tmp_path):
    target = tmp_path / "target"
    target.write_bytes(b"another's")
    (tmp_path / "file").symlink_to(target)
    with replacing(tmp_path / "file") as file:
        file.write(b"new")
    assert target.read_bytes() == b"another's"
    assert not (tmp_path / "file").is_symlink()


@pytest.mark.parametrize("planted", ["link", "folder"])
def test_a_folder_that_another_user_planted_is_not_written_to(
    tmp_path, monkeypatch, caplog, plant, planted
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    victim = tmp_path / "victim"
    victim.mkdir()
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    plant(shared / "mjlab", victim if planted == "link" else None)
    own = own_folder(shared / "mjlab" / "nan_dumps")
    assert own == tmp_path / "cache" / "mjlab" / "nan_dumps"
    assert own.is_dir()
    assert not list(victim.iterdir())
    for fact in (str(shared / "mjlab"), str(own), "another user"):
        assert fact in caplog.text


def test_a_folder_of_this_user_is_taken_whatever_it_is_in(tmp_path):
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    assert own_folder(shared / "mjlab" / "nan_dumps") == shared / "mjlab" / "nan_dumps"
    (shared / "link").symlink_to(tmp_path)
    assert own_folder(shared / "link" / "dumps").is_dir()
    assert (tmp_path / "dumps").is_dir()


WRITE = """
import sys, time
from pathlib import Path
from mjlab.utils.os import replacing
with replacing(Path(sys.argv[1])) as file:
    file.write(b"half")
    file.flush()
    print("writing", flush=True)
    time.sleep(60)
"""


def test_temporary_files_of_killed_processes_go(tmp_path):
    other = tmp_path / ".model_1.pt.abcdefgh.tmp"
    other.touch()
    command = [sys.executable, "-c", WRITE, str(tmp_path / "model_2.pt")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.readline()
    try:
        remove_temporary_files(tmp_path)
        assert len(list(tmp_path.iterdir())) == 2
    finally:
        process.kill()
        process.communicate()
    assert len(list(tmp_path.iterdir())) == 2
    remove_temporary_files(tmp_path)
    assert list(tmp_path.iterdir()) == [other]
    with replacing(tmp_path / "model_3.pt") as file:
        remove_temporary_files(tmp_path)
        file.write(b"whole")
    assert (tmp_path / "model_3.pt").read_bytes() == b"whole"


def test_temporary_files_of_other_machines_are_kept_for_a_day(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("socket.gethostname", lambda: "elsewhere")
    new, old = (temporary_path(tmp_path / name) for name in ("new.pt", "old.pt"))
    monkeypatch.undo()
    for path in (new, old):
        path.touch()
    os.utime(old, (1e9, 1e9))
    remove_temporary_files(tmp_path)
    assert [*tmp_path.iterdir()] == [new]
