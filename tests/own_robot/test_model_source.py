"""Models from files, folders, archives and functions."""

from __future__ import annotations

import keyword
import subprocess
import sys
import types
import zipfile
from pathlib import Path

import mujoco
import pytest
from legged import legged_spec
from small_robots import arm_spec, write_archive, write_quadruped, write_urdf

from mjlab.own_robot.model_source import identifier, load_model, model_file, name_elements
from mjlab.own_robot.report import describe_robot

ROBOT = "<mujoco><worldbody><body><geom name='g' size='.1'/></body></worldbody></mujoco>"


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (("scene.xml", "dog.xml"), "dog.xml"),
        (("scene_flat.xml", "dog.xml", "dog_mjx.xml"), "dog.xml"),
        (("dog.urdf", "dog.xml"), "dog.xml"),
        (("extra/cat.xml", "cat.xml"), "cat.xml"),
    ],
)
def test_plainest_model_of_a_folder(tmp_path, files, expected):
    folder = tmp_path / "robot"
    for name in files:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        urdf = "<robot name='r'><link name='base'/></robot>"
        path.write_text(urdf if name.endswith("urdf") else ROBOT)
    assert model_file(folder).relative_to(folder).as_posix() == expected


def test_candidates_are_listed(tmp_path):
    for name in ("cat.xml", "dog.xml"):
        (tmp_path / name).write_text(ROBOT)
    with pytest.raises(ValueError, match=r"cat\.xml.*dog\.xml"):
        model_file(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="no MJCF or URDF"):
        model_file(tmp_path / "empty")


def test_file_folder_and_archive_are_one_model(tmp_path):
    file = write_quadruped(tmp_path / "dog")
    sources = [str(file), str(file.parent), str(write_archive(tmp_path / "archived"))]
    models = [load_model(source) for source in sources]
    assert {model.name for model in models} == {"dog"}
    assert len({model.spec.compile().nbody for model in models}) == 1
    assert not any(model.is_urdf for model in models)


def test_archive_without_a_model(tmp_path):
    path = tmp_path / "notes.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("notes.txt", "no robot")
    with pytest.raises(ValueError, match="no MJCF or URDF"):
        load_model(str(path))


def test_archive_leaves_no_folder(tmp_path):
    code = (
        "import sys; from pathlib import Path; from mjlab.own_robot.model_source import model_file; "
        "print(model_file(Path(sys.argv[1])))"
    )
    words = [sys.executable, "-c", code, str(write_archive(tmp_path))]
    outcome = subprocess.run(words, capture_output=True, text=True, check=True)
    assert outcome.stdout.strip().endswith("dog.xml")
    assert not Path(outcome.stdout.strip()).exists()


def test_function(monkeypatch):
    module = types.ModuleType("cranes")
    module.crane, module.number = arm_spec, lambda: 3
    monkeypatch.setitem(sys.modules, "cranes", module)
    assert load_model("cranes:crane").name == "crane"
    with pytest.raises(ValueError, match="MjSpec"):
        load_model("cranes:number")


def test_menagerie_without_its_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", None)
    with pytest.raises(ModuleNotFoundError, match=r"mjlab\[menagerie\]"):
        load_model("menagerie:unitree_go2")


class MenagerieError(Exception):
    """Base of the package's errors."""


def test_menagerie(monkeypatch, tmp_path):
    file = write_quadruped(tmp_path / "dog")

    def get(name: str) -> types.SimpleNamespace:
        if name != "dog":
            raise MenagerieError("Did you mean 'dog'?")
        return types.SimpleNamespace(default_model="dog", xml=lambda entry: file)

    module = types.SimpleNamespace(get=get, MenagerieError=MenagerieError)
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", module)
    assert load_model("menagerie:dog").file == file
    with pytest.raises(ValueError, match="'menagerie:dgo': Did you mean 'dog'"):
        load_model("menagerie:dgo")


def test_menagerie_with_a_filled_cache(monkeypatch, tmp_path):
    menagerie = pytest.importorskip("mujoco_menagerie", reason="needs mjlab[menagerie]")
    cache = menagerie.Cache(tmp_path)
    monkeypatch.setenv("MENAGERIE_CACHE_DIR", str(tmp_path))
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    robot = menagerie.get("unitree_go2")
    # Published: the model, and the file that says that it is complete.
    folder = cache.model_path(robot)
    write_quadruped(folder).rename(folder / robot.entry(robot.default_model).file)
    (folder / ".complete").write_text("{}")
    model = load_model("menagerie:unitree_go2")
    assert (model.name, model.assets) == ("go2", folder)
    assert model.spec.compile().njnt == 13
    with pytest.raises(ValueError, match="unitree_go2"):
        load_model("menagerie:unitree_go3")


def test_missing_file():
    with pytest.raises(ValueError, match="no such file"):
        load_model("nowhere.xml")


def test_pairs_with_geoms_of_a_scene(tmp_path):
    path = tmp_path / "robot.xml"
    pair = "<contact><pair geom1='g' geom2='floor'/></contact></mujoco>"
    path.write_text(ROBOT.replace("</mujoco>", pair))
    with pytest.warns(UserWarning, match="floor"):
        model = load_model(str(path))
    assert model.spec.compile().npair == 0


def test_names_are_unique_and_say_the_body():
    spec = legged_spec(4)
    new = name_elements(spec)
    assert "a0_calf_collision" in new
    assert "a0_hip_visual" in new
    model = spec.compile()
    for count, kind in (
        (model.nbody, mujoco.mjtObj.mjOBJ_BODY),
        (model.njnt, mujoco.mjtObj.mjOBJ_JOINT),
        (model.ngeom, mujoco.mjtObj.mjOBJ_GEOM),
    ):
        names = [mujoco.mj_id2name(model, kind, i) for i in range(count)]
        assert all(names)
        assert len(set(names)) == count
    assert name_elements(spec) == []


def test_base_of_a_urdf_is_asked(tmp_path):
    path = write_urdf(tmp_path)
    report = describe_robot(str(path))
    # Joints named hip and calf: a robot with legs.
    assert report.anatomy.kind.value == "legged"
    assert "floating_base" in {question.key for question in report.questions}
    fixed = describe_robot(str(path), {"floating_base": "false"})
    assert fixed.anatomy.kind.value != "legged"
    assert "floating_base" not in {question.key for question in fixed.questions}


@pytest.mark.parametrize("name", ["2legs", "class", "My Robot-3", "..."])
def test_identifier_is_a_python_name(name: str) -> None:
    found = identifier(name)
    assert found.isidentifier()
    assert not keyword.iskeyword(found)
    assert identifier(found).strip("_") == found.strip("_")
