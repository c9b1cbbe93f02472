"""`export-scene` writes what an environment simulates, and destroys nothing."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import mujoco
import pytest

from mjlab.envs import ManagerBasedRlEnv
from mjlab.scripts.export_scene import ExportSceneConfig, run_export_scene
from mjlab.tasks.registry import load_env_cfg
from mjlab.utils.signals import Interrupted

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"
OPTIONS = ("timestep", "cone", "impratio", "solver", "iterations", "ls_iterations", "disableflags")


def test_a_tasks_scene_is_read_back_with_its_physics_options(run, tmp_path: Path) -> None:
    outcome = run("export_scene", TASK, "--output-dir", str(tmp_path / "out"))
    assert outcome.status == 0, outcome.err
    assert outcome.out == f"Wrote {tmp_path / 'out' / 'scene.xml'}.\n"
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "scene.xml"))
    cfg = load_env_cfg(TASK)
    cfg.scene.num_envs = 1
    env = ManagerBasedRlEnv(cfg, device="cpu")
    simulated = env.sim.mj_model
    env.close()
    # Other than MuJoCo's defaults, so that the comparison says something.
    assert (written.opt.timestep, written.opt.cone) != (0.002, 0)
    for name in OPTIONS:
        assert getattr(written.opt, name) == getattr(simulated.opt, name), name
    for count in ("nq", "nv", "nu", "ngeom", "nsensor"):
        assert getattr(written, count) == getattr(simulated, count), count
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["scene.xml"]


@pytest.mark.parametrize("robot", ["g1", "go1", "yam"])
def test_a_robot_has_a_short_name(robot: str, tmp_path: Path) -> None:
    folder = run_export_scene(robot, ExportSceneConfig(output_dir=str(tmp_path / robot)))
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    assert model.body(1).name.startswith("robot/")
    assert model.nu > 5


def test_an_archive_is_written_on_request(run, tmp_path: Path) -> None:
    outcome = run("export_scene", "go1", "--zip", "--output-dir", str(tmp_path / "robot"))
    assert outcome.status == 0, outcome.err
    assert [p.name for p in tmp_path.iterdir()] == ["robot.zip"]
    with zipfile.ZipFile(tmp_path / "robot.zip") as archive:
        assert "scene.xml" in archive.namelist()
    again = run("export_scene", "go1", "--zip", "--output-dir", str(tmp_path / "robot"))
    assert again.status == 1
    assert "robot.zip exists" in again.message


def test_an_archive_of_the_folder_above_holds_the_scene_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "above" / "here").mkdir(parents=True)
    (tmp_path / "above" / "thesis.txt").write_text("years of work")
    monkeypatch.chdir(tmp_path / "above" / "here")
    # Packed from a folder of temporary files, with no other content.
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "above"))
    result = run_export_scene("go1", ExportSceneConfig(output_dir="..", zip=True))
    assert result.resolve() == tmp_path / "above.zip"
    with zipfile.ZipFile(result) as archive:
        assert [n for n in archive.namelist() if not n.endswith("/")] == ["scene.xml"]
    here = run_export_scene("go1", ExportSceneConfig(output_dir=".", zip=True))
    assert here.resolve() == tmp_path / "above" / "here.zip"
    named = run_export_scene("go1", ExportSceneConfig(output_dir="robot.zip", zip=True))
    assert named == Path("robot.zip")
    with pytest.raises(ValueError, match="empty name"):
        run_export_scene("go1", ExportSceneConfig(output_dir="/", zip=True))


def test_a_folder_with_files_is_left_alone(run, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    outcome = run("export_scene", "go1", "--output-dir", str(tmp_path))
    assert outcome.status == 1
    assert "is not empty" in outcome.message
    assert "--overwrite" in outcome.message
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_file_in_the_folders_place_is_left_alone(overwrite: bool, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("years of work")
    cfg = ExportSceneConfig(output_dir=str(tmp_path / "out"), overwrite=overwrite)
    with pytest.raises(OSError, match="out"):
        run_export_scene("go1", cfg)
    assert (tmp_path / "out").read_text() == "years of work"


def test_overwriting_replaces_an_export_and_nothing_else(run, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets" / "old.stl").write_bytes(b"old")
    (tmp_path / "scene.xml").write_text("old")
    outcome = run("export_scene", "go1", "--overwrite", "--output-dir", str(tmp_path))
    assert outcome.status == 0, outcome.err
    assert {p.name for p in tmp_path.iterdir()} == {"thesis.txt", "scene.xml"}
    assert (tmp_path / "scene.xml").read_text() != "old"


@pytest.mark.parametrize("is_zip", [False, True])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, is_zip: bool
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    writes = Path.write_bytes

    def write_bytes(path: Path, content: bytes) -> None:
        writes(path, content)
        os.kill(os.getpid(), number)

    monkeypatch.setattr(Path, "write_bytes", write_bytes)
    cfg = ExportSceneConfig(output_dir=str(tmp_path / "out"), zip=is_zip)
    with pytest.raises(Interrupted) as stopped:
        run_export_scene("go1", cfg)
    assert stopped.value.exit_status == 128 + number
    assert signal.getsignal(number) == signal.SIG_DFL
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_named_and_leaves_nothing(
    run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write_bytes(path: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", write_bytes)
    outcome = run("export_scene", "go1", "--output-dir", str(tmp_path / "out"))
    assert outcome.status == 1
    assert "No space left on device" in outcome.message
    assert "scene.xml" in outcome.message
    assert not list(tmp_path.iterdir())
    (tmp_path / "mine").mkdir()
    assert run("export_scene", "go1", "--output-dir", str(tmp_path / "mine")).status == 1
    assert (tmp_path / "mine").is_dir()


def test_a_function_of_another_module_makes_the_entity(
    run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_robot_7.py").write_text(
        "import mujoco\n"
        "from mjlab.entity import EntityCfg\n"
        'XML = \'<mujoco><worldbody><body name="ball"><freejoint/><geom name="skin" '
        'size=".1" type="mesh" mesh="m"/></body></worldbody><asset><mesh name="m" file="m.obj"/>'
        "</asset></mujoco>'\n"
        "OBJ = b'v 0 0 0\\nv 1 0 0\\nv 0 1 0\\nv 0 0 1\\nf 1 3 2\\nf 1 2 4\\nf 1 4 3\\nf 2 3 4\\n'\n"
        "def make():\n"
        "    spec = mujoco.MjSpec.from_string(XML)\n"
        "    spec.assets = {'m.obj': OBJ}\n"
        "    return EntityCfg(spec_fn=lambda: spec.copy())\n"
        "NOTHING = 3\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    outcome = run("export_scene", "my_robot_7:make", "--output-dir", "out")
    assert outcome.status == 0, outcome.err
    model = mujoco.MjModel.from_xml_path("out/scene.xml")
    assert model.body(1).name == "robot/ball"
    assert [p.name for p in (tmp_path / "out" / "assets").rglob("*.obj")] == ["m.obj"]
    wrong = run("export_scene", "my_robot_7:NOTHING", "--output-dir", "other")
    assert "got int" in wrong.message
    missing = run("export_scene", "my_robot_7:absent", "--output-dir", "other")
    assert "cannot be imported" in missing.message
    assert not (tmp_path / "other").exists()


def test_an_unknown_target_is_an_error_that_lists_the_choices(run, tmp_path: Path) -> None:
    outcome = run("export_scene", "Mjlab-Cartpole-Swing", "--output-dir", str(tmp_path / "x"))
    assert outcome.status == 1
    assert "Mjlab-Cartpole-Swingup" in outcome.message
    assert "g1, go1, yam" in outcome.message
    assert not (tmp_path / "x").exists()


def test_help_comes_without_building_anything() -> None:
    code = (
        "import sys; sys.argv = ['export-scene', '--help']\n"
        "from mjlab.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert end.code == 0\n"
        "assert not {'torch', 'mujoco', 'tyro'} & set(sys.modules)"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "Write scene.xml" in told.stdout


def test_flags_come_after_the_target(run) -> None:
    message = run("export_scene", "--zip", "go1").message
    assert "TARGET" in message
    assert "--zip" in message
