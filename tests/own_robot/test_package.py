"""Packages of small robots import, build and stand, and a user's edits are kept."""

from __future__ import annotations

import importlib
import pkgutil
import re
import runpy
import subprocess
import sys
import tomllib
import warnings
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

import mujoco
import pytest
import torch
from legged import legged_spec
from packaging.requirements import Requirement
from small_robots import arm_spec, write_archive, write_quadruped, write_still_motion, write_urdf
from tensordict import TensorDict

from mjlab.entity import EntityCfg
from mjlab.envs import ManagerBasedRlEnv
from mjlab.own_robot.model_source import RobotModel, model_file
from mjlab.own_robot.package import Package, questions_table, values_table
from mjlab.own_robot.report import describe_robot
from mjlab.own_robot.rewriting import Record, deleted_files, read_record, write_files
from mjlab.own_robot.robot_source import by_pattern
from mjlab.tasks.velocity.symmetry import mirror_left_right
from mjlab.utils.errors import UserError

ROBOT = "src/dog/robot.py"


@pytest.fixture
def registered(monkeypatch) -> list[dict]:
    """Tasks registered by packages; those of this process stay as they are."""
    tasks: list[dict] = []
    monkeypatch.setattr(
        "mjlab.tasks.registry.register_mjlab_task", lambda **task: tasks.append(task)
    )
    return tasks


@pytest.fixture
def imported(monkeypatch, registered: list[dict]) -> Iterator:
    """Function that imports a module of a written package."""
    names: list[str] = []

    def load(folder: Path, module: str) -> ModuleType:
        monkeypatch.syspath_prepend(str(folder / "src"))
        names.append(module.partition(".")[0])
        return importlib.import_module(module)

    yield load
    for name in list(sys.modules):
        if name.partition(".")[0] in names:
            del sys.modules[name]


def written(folder: Path, package: Package) -> Path:
    write_files(folder, package.files("mjlab new-robot", folder), Record())
    return folder


def quadruped(folder: Path, **settings: str) -> Package:
    return Package("dog", "velocity", describe_robot(str(write_quadruped(folder)), settings))


@pytest.fixture(params=["mjcf", "urdf", "zip"])
def dog(request, tmp_path: Path) -> Path:
    """Package of the quadruped, from one of its forms."""
    settings = {}
    if request.param == "mjcf":
        source = write_quadruped(tmp_path / "model")
    elif request.param == "zip":
        source = model_file(write_archive(tmp_path / "model"))
    else:
        source = write_urdf(tmp_path / "model")
        settings = {"floating_base": "true", "armature": "0.005"}
    report = describe_robot(str(source), settings)
    return written(tmp_path / "dog_package", Package("dog", "velocity", report))


def test_robot_is_that_of_the_model(dog: Path, imported) -> None:
    cfg: EntityCfg = imported(dog, "dog.robot").get_robot_cfg()
    model = cfg.build().compile()
    assert model.njnt == 13
    assert model.nu == 12
    # All that the package needs is in its folder.
    meshes = [Path(mesh.file) for mesh in cfg.spec_fn().meshes]
    assert len(meshes) == 1
    assert (dog / "src" / "dog" / "model" / "meshes" / meshes[0].name).is_file()
    for sole in imported(dog, "dog.robot").SOLES:
        geom = model.geom(sole)
        assert (geom.priority.item(), geom.condim.item()) == (1, 3)
        assert geom.group.item() != 0


def test_registered_names_resolve(dog: Path, imported, registered: list[dict]) -> None:
    imported(dog, "dog")
    assert [task["task_id"] for task in registered] == ["Velocity-Flat-Dog", "Velocity-Rough-Dog"]
    for task in registered:
        for name in (task["env_cfg"], task["rl_cfg"], task["profiles"]["cpu"]):
            assert pkgutil.resolve_name(name)


@pytest.mark.parametrize("terrain", ["flat", "rough"])
def test_task_stands_and_mirrors(tmp_path: Path, imported, terrain: str) -> None:
    folder = written(tmp_path / "dog_package", quadruped(tmp_path / "model"))
    cfg = getattr(imported(folder, "dog.task"), f"{terrain}_env_cfg")(play=True)
    cfg.scene.num_envs = 2
    # On the lowest level: one robot in a hundred slides off steep slopes within these steps.
    cfg.scene.terrain.max_init_terrain_level = 0
    cfg.events.pop("randomize_terrain", None)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    observations, _ = env.reset()
    for _ in range(20):
        _, _, terminated, _, _ = env.step(torch.zeros(2, 12))
        assert not terminated.any()
    assert "base_lin_vel" not in cfg.observations["actor"].terms
    mirrored, _ = mirror_left_right(env, TensorDict(observations, batch_size=[2]))
    assert mirrored["actor"].shape[0] == 4
    env.close()


@pytest.mark.parametrize("size", [1.0, 2.0])
def test_feet_are_lifted_by_the_size_of_the_robot(tmp_path: Path, imported, size: float) -> None:
    spec = legged_spec(4, size=size)
    report = describe_robot(RobotModel(spec, "robot", "robot", None, None))
    folder = written(tmp_path / "p", Package("dog", "velocity", report))
    rewards = imported(folder, "dog.task").flat_env_cfg().rewards
    for name in ("foot_clearance", "foot_swing_height"):
        height = rewards[name].params["target_height"]
        assert height == pytest.approx(0.36 * report.root_height.value, rel=0.05)


def test_lines_are_no_longer_than_100(tmp_path: Path) -> None:
    files = quadruped(tmp_path / "model").files("mjlab new-robot", tmp_path)
    for name, content in files.items():
        if name.endswith(".py"):
            assert max(map(len, content.decode().splitlines())) <= 100


def test_trunk_on_the_ground_is_a_fall(tmp_path: Path, imported) -> None:
    folder = written(tmp_path / "dog_package", quadruped(tmp_path / "model"))
    cfg = imported(folder, "dog.task").flat_env_cfg(play=True)
    cfg.scene.num_envs = 1
    cfg.scene.entities["robot"].init_state.pos = (0.0, 0.0, 0.06)
    cfg.scene.entities["robot"].init_state.joint_pos = {".*_thigh": 2.5, ".*_calf": -0.5}
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    ended = [bool(env.step(torch.zeros(1, 12))[2].any()) for _ in range(25)]
    assert any(ended)
    env.close()


def test_trot_pairs_diagonal_feet(tmp_path: Path, imported) -> None:
    folder = written(tmp_path / "dog_package", quadruped(tmp_path / "model"))
    feet = imported(folder, "dog.robot").FEET
    assert feet == ("FL_calf_foot", "FR_calf_foot", "RL_calf_foot", "RR_calf_foot")
    task = (folder / "src" / "dog" / "task.py").read_text()
    assert "((0, 3), (1, 2))" in task


@pytest.mark.parametrize(("legs", "share"), [(2, 0.6), (4, 0.4)])
def test_training_stops_at_shares_of_standing_still(tmp_path: Path, imported, legs, share) -> None:
    report = describe_robot(RobotModel(legged_spec(legs), "robot", "robots:legged", None, None))
    folder = written(tmp_path, Package(f"robot{legs}", "velocity", report))
    task = imported(folder, f"robot{legs}.task")
    env_cfg, rl_cfg = task.flat_env_cfg(), task.rl_cfg()
    task.cpu.easing(env_cfg, rl_cfg)
    assert rl_cfg.evaluation.solved_below["lin_vel_error_share"] == share
    # Errors are measured, and compared with those of standing still.
    assert {"lin_vel_error", "ang_vel_error"} <= rl_cfg.evaluation.standing_still.keys()


def test_two_legs_learn_from_steps(tmp_path: Path, imported) -> None:
    report = describe_robot(RobotModel(legged_spec(2), "robot", "robot", None, None))
    folder = written(tmp_path / "package", Package("stilts", "velocity", report))
    task = imported(folder, "stilts.task")
    cfg, rl_cfg = task.flat_env_cfg(), task.rl_cfg()
    learner = task.cpu.policy(cfg, rl_cfg)
    task.cpu.easing(cfg, learner)
    assert learner.algorithm.teacher in cfg.observations
    # At the Froude number of the G1.
    height = imported(folder, "stilts.robot").HEIGHT
    assert cfg.commands["gait"].frequency == pytest.approx(1.88 * (0.76 / height) ** 0.5, rel=0.01)
    cfg.scene.num_envs = 2
    env = ManagerBasedRlEnv(cfg, device="cpu")
    observations, _ = env.reset()
    mirrored, _ = mirror_left_right(env, TensorDict(observations, batch_size=[2]))
    assert mirrored["teacher"].shape == (4, 8)
    knees = [
        env.action_manager.get_term("joint_pos").target_names.index(n) for n in ("a0_3", "b0_3")
    ]
    assert task.BOUNDS == {".*_1": 0.6, ".*_2": 1.0, ".*_3": 1.0, ".*_4": 1.0}
    bends = []
    for _ in range(25):
        observations, *_ = env.step(observations["teacher"].clamp(-1.0, 1.0))
        bends.append(observations["teacher"][0, knees])
    left, right = torch.stack(bends).amax(dim=0)
    assert left > 0.0
    assert right > 0.0
    env.close()


def test_own_tests_pass(tmp_path: Path, imported) -> None:
    folder = written(tmp_path / "dog_package", quadruped(tmp_path / "model"))
    imported(folder, "dog.task")
    tests = runpy.run_path(str(folder / "tests" / "test_dog.py"))
    tests["test_stands_for_two_seconds"]()
    tests["test_steps"](tests["rough_env_cfg"])


def test_arm_of_a_function(tmp_path: Path, imported) -> None:
    model = RobotModel(arm_spec(), "crane", "cranes:arm_spec", None, None)
    package = Package("crane", "bare", describe_robot(model))
    folder = written(tmp_path, package)
    robot = imported(folder, "crane.robot")
    built = robot.get_robot_cfg().build()
    assert built.num_joints == 6
    # The servos of the file are replaced, not doubled.
    assert built.compile().nu == 6
    # Its joints have one effort limit.
    assert [row[0] for row in questions_table(package.report).rows] == ["pose", "effort"]


def test_reach_task_of_an_arm(tmp_path: Path, imported, registered: list[dict]) -> None:
    report = describe_robot(RobotModel(arm_spec(), "crane", "cranes:arm_spec", None, None))
    folder = written(tmp_path, Package("crane", "reach", report))
    imported(folder, "crane")
    assert [task["task_id"] for task in registered] == ["Reach-Crane"]
    cfg = imported(folder, "crane.task").env_cfg()
    cfg.scene.num_envs = 2
    cfg.commands["hand_pose"].num_goals = 16
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    assert env.action_manager.total_action_dim == 6
    env.step(torch.zeros(2, 6))
    env.close()


def test_tracking_task_of_a_motion(tmp_path: Path, imported) -> None:
    package = quadruped(tmp_path / "model")
    motion = write_still_motion(package.report.compiled, tmp_path / "still.npz")
    folder = written(tmp_path / "package", Package("dog", "tracking", package.report, motion))
    cfg = imported(folder, "dog.task").env_cfg(play=True)
    assert cfg.commands["motion"].body_names[0] == "trunk"
    cfg.scene.num_envs = 2
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    env.step(torch.zeros(2, 12))
    env.close()


def test_setting_changes_a_value_and_its_reason(tmp_path: Path) -> None:
    before = quadruped(tmp_path / "a")
    after = quadruped(tmp_path / "b", stiffness="33", **{"pose.FL_calf": "-1.5"})
    assert "stiffness=33.0" in after.files("", Path("dog"))[ROBOT].decode()
    assert "stiffness=33.0" not in before.files("", Path("dog"))[ROBOT].decode()
    # One joint of the pose.
    rows = {(row[0], row[2]): row[1] for row in values_table(after.report).rows}
    assert ("stiffness", "guessed") not in rows
    assert rows["pose", "set"] == "FL_calf -1.5"
    assert "FR_calf" in rows["pose", "guessed"]


def test_table_shows_all_joints(tmp_path: Path) -> None:
    report = quadruped(tmp_path / "model").report
    shown = " ".join(row[1] for row in values_table(report).rows if row[0] == "pose")
    for name in by_pattern({n: q for n, q in report.joint_pos.value.items() if q}, report):
        assert name in shown


@pytest.mark.parametrize("legs", [2, 4])
def test_readme_and_task_have_the_names_of_each_other(tmp_path: Path, imported, legs: int) -> None:
    report = describe_robot(RobotModel(legged_spec(legs), "robot", "robot", None, None))
    folder = written(tmp_path, Package(f"robot{legs}", "velocity", report))
    readme, task = (folder / "README.md").read_text(), imported(folder, f"robot{legs}.task")
    assert ("BIPED" in readme) == (legs == 2) == hasattr(task, "BIPED")
    # No claim that two legs stand by themselves.
    assert ("; stands" in readme or "| stands" in readme) == (legs == 4)
    if legs == 2:
        for gains in re.findall(r"gains=(mdp\.\w+)", readme):
            assert replace(
                task.BIPED, gains=pkgutil.resolve_name(f"mjlab.tasks.velocity.{gains}")()
            )


def test_two_legs_fall_late(tmp_path: Path, imported) -> None:
    report = describe_robot(RobotModel(legged_spec(2), "robot", "robot", None, None))
    folder = written(tmp_path, Package("stilts", "velocity", report))
    imported(folder, "stilts.task")
    tests = runpy.run_path(str(folder / "tests" / "test_stilts.py"))
    assert not any("stand" in name for name in tests if name.startswith("test_"))
    tests["test_falls_late"]()


def test_project_requires_this_release(tmp_path: Path) -> None:
    project = tomllib.loads(
        quadruped(tmp_path / "m").files("", tmp_path)["pyproject.toml"].decode()
    )
    (requirement,) = map(Requirement, project["project"]["dependencies"])
    assert requirement.specifier.contains(version("mjlab"), prereleases=True)
    assert not requirement.specifier.contains("1.6.0")


@pytest.mark.parametrize("task", ["velocity", "bare"])
def test_ruff_accepts_files(tmp_path: Path, task: str) -> None:
    package = replace(quadruped(tmp_path / "model"), task=task)
    folder = written(tmp_path / "package", package)
    words = [
        "ruff",
        "check",
        "--isolated",
        "--select",
        "E,F,I",
        "--line-length",
        "100",
        str(folder),
    ]
    outcome = subprocess.run(
        [sys.executable, "-m", *words], cwd=folder, capture_output=True, text=True, check=False
    )
    assert outcome.returncode == 0, outcome.stdout


# Later runs.


def test_edits_are_kept(tmp_path: Path) -> None:
    folder = tmp_path / "dog_package"
    package = quadruped(tmp_path / "model")
    files = package.files("", folder)
    assert write_files(folder, files, read_record(folder)) == []
    (folder / ROBOT).write_text("# mine\n")
    changed = files | {ROBOT: b"# new\n", "pyproject.toml": b"new\n"}
    assert write_files(folder, changed, read_record(folder)) == [ROBOT]
    assert (folder / ROBOT).read_text() == "# mine\n"
    assert (folder / f"{ROBOT}.new").read_text() == "# new\n"
    assert (folder / "pyproject.toml").read_text() == "new\n"
    # The next run keeps the edits too.
    assert write_files(folder, files, read_record(folder)) == [ROBOT]
    assert (folder / ROBOT).read_text() == "# mine\n"


def test_edits_of_a_new_file_are_not_lost(tmp_path: Path) -> None:
    folder, new = tmp_path / "dog_package", tmp_path / "dog_package" / f"{ROBOT}.new"
    files = quadruped(tmp_path / "model").files("", folder)
    write_files(folder, files, read_record(folder))
    (folder / ROBOT).write_text("# mine\n")
    write_files(folder, files, read_record(folder))
    new.write_text("# half merged\n")
    with pytest.raises(UserError, match="robot.py.new"):
        write_files(folder, files | {"pyproject.toml": b""}, read_record(folder))
    assert new.read_text() == "# half merged\n"
    assert (folder / "pyproject.toml").read_bytes() == files["pyproject.toml"]
    new.unlink()
    assert write_files(folder, files, read_record(folder)) == [ROBOT]


def test_deleted_tests_do_not_come_back(tmp_path: Path) -> None:
    folder, test = tmp_path / "dog_package", "tests/test_dog.py"
    files = quadruped(tmp_path / "model").files("", folder)
    write_files(folder, files, read_record(folder))
    (folder / test).unlink()
    (folder / ROBOT).unlink()
    for _ in range(2):
        write_files(folder, files, read_record(folder))
        assert deleted_files(folder, read_record(folder)) == [test]
        # The package does not work without it.
        assert (folder / ROBOT).exists()


def test_other_folders_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="--output"):
        read_record(tmp_path)


# Parts of robots that files have otherwise.


def spec_of(package: Package, folder: Path, imported) -> mujoco.MjSpec:
    return imported(written(folder, package), "dog.robot").get_spec()


def test_own_ground_goes_and_other_geoms_leave_the_ray_group(tmp_path: Path, imported) -> None:
    spec = spec_of(quadruped(tmp_path / "model"), tmp_path / "package", imported)
    assert not spec.worldbody.geoms
    assert all(geom.group != 0 for geom in spec.geoms)


def test_other_oddities_of_a_file(tmp_path: Path, imported) -> None:
    """No geom collides by itself, the file has physics of its own, and a body is fixed to the world."""
    path = write_quadruped(tmp_path / "model")
    text = path.read_text().replace("<worldbody>", '<worldbody><body name="dock"/>')
    text = text.replace(
        "<asset>", '<option impratio="100" cone="elliptic"/><size nconmax="9"/><asset>'
    )
    off = ' contype="0" conaffinity="0"'
    path.write_text(text.replace(off, "").replace("<geom", f"<geom{off}"))
    spec = spec_of(Package("dog", "velocity", describe_robot(str(path))), tmp_path / "p", imported)
    assert spec.body("dock") is None
    assert (spec.option.impratio, spec.nconmax) == (1.0, -1)
    model = spec.compile()
    soles = [geom for geom in range(model.ngeom) if model.geom_priority[geom] == 1]
    assert len(soles) == 4
    assert model.geom_conaffinity[soles].all()
    assert not model.geom_contype.any()


def test_names_with_spaces_and_quotes(tmp_path: Path, imported) -> None:
    path = write_quadruped(tmp_path / "model")
    text = path.read_text().replace('"trunk"', "'the \"big\" trunk'").replace("_calf", "_ca\\lf")
    path.write_text(text.replace("_", " "))
    package = Package("dog", "velocity", describe_robot(str(path)))
    with warnings.catch_warnings():
        warnings.simplefilter("error", SyntaxWarning)
        model = imported(written(tmp_path / "p", package), "dog.robot").get_robot_cfg().build()
    assert model.compile().nu == 12


@pytest.mark.parametrize(("name", "distribution"), [("_2legs", "2legs"), ("class_", "class")])
def test_name_of_the_distribution(tmp_path: Path, name: str, distribution: str) -> None:
    package = replace(quadruped(tmp_path / "model"), name=name)
    project = tomllib.loads(package.files("", tmp_path)["pyproject.toml"].decode())["project"]
    assert project["name"] == distribution


def test_rotated_imu_is_replaced(tmp_path: Path, imported) -> None:
    path = write_quadruped(tmp_path / "model")
    path.write_text(
        path.read_text().replace('<site name="imu"/>', '<site name="imu" euler="0 0 1.57"/>')
    )
    package = Package("dog", "velocity", describe_robot(str(path)))
    spec = spec_of(package, tmp_path / "package", imported)
    gyro = next(sensor for sensor in spec.sensors if sensor.name == "imu_ang_vel")
    assert gyro.objname == "trunk_imu"
    assert spec.site("imu") is not None
