"""The check of a bundle as it is written, and what it reports."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from bundles import BUNDLES, write_random

from mjlab.deploy.check import TOLERANCES, check_bundle, undecided
from mjlab.deploy.evidence import Evidence
from mjlab.deploy.fitness import fitness_warnings
from mjlab.deploy.logs import check_log
from mjlab.utils.errors import UserError


@pytest.mark.parametrize("name", BUNDLES)
def test_bundle_as_written_passes(bundle, name):
    report = check_bundle(bundle(name))
    assert report.is_passed, str(report)
    assert [one.stage for one in report.comparisons] == sorted(
        (one.stage for one in report.comparisons), key=list(TOLERANCES).index
    )
    # All stages, for all robots.
    assert {one.stage for one in report.comparisons} == set(TOLERANCES)


@pytest.fixture
def folder(bundle, tmp_path) -> Path:
    """Return a copy of the Go1's bundle."""
    return Path(shutil.copytree(bundle("go1"), tmp_path / "bundle"))


def test_period_that_float32_rounds(tmp_path):
    def at_30_hz(env: Any, agent: Any) -> None:
        env.sim.mujoco.timestep, env.decimation = 1.0 / 120.0, 4

    folder = write_random("Mjlab-Cartpole-Swingup", tmp_path / "bundle", at_30_hz)
    content = json.loads((folder / "contract.json").read_text())
    assert content["rates"]["step_dt"] == pytest.approx(1.0 / 30.0, rel=1e-15)
    report = check_bundle(folder)
    assert report.is_passed, str(report)
    # An older bundle, and another rate.
    edit_contract(folder, lambda content: content["rates"].update(step_dt=0.033333335))
    assert check_bundle(folder).is_passed
    edit_contract(folder, lambda content: content["rates"].update(step_dt=0.0334))
    assert check_bundle(folder).causes == ["other control rate"]


def term_of(content: dict[str, Any], name: str) -> dict[str, Any]:
    return next(one for one in content["observations"][0]["terms"] if one["name"] == name)


def edit_contract(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    content = json.loads((folder / "contract.json").read_text())
    change(content)
    (folder / "contract.json").write_text(json.dumps(content))


def edit_program(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_report_says_where_and_why(folder):
    edit_contract(folder, lambda content: term_of(content, "joint_pos").update(offset=None))
    report = check_bundle(folder)
    assert "raw/obs/joint_pos" in str(report)
    assert "_calf_joint" in str(report)
    assert report.causes == ["default pose not subtracted"]
    finding = report.as_dict()["findings"][0]
    assert finding["stage"] == "term"
    assert finding["cause"] == "default pose not subtracted"
    # Stages that start from the trace are equal all the same.
    equal = {one.stage for one in report.comparisons if one.is_equal}
    assert equal >= {"sensors", "torque", "state", "next sensors"}


def test_formula_of_the_user_is_known_to_the_causes(folder):
    function = "my_package.mdp:speeds"
    edit_contract(
        folder,
        lambda content: term_of(content, "joint_vel").update(kind="custom", function=function),
    )
    for check in (check_bundle, lambda folder: check_log(folder, folder / "golden.csv")):
        with pytest.raises(UserError, match=function):
            check(folder)
    # A policy with such a term has no files for Unitree's programs.
    shutil.rmtree(folder / "params")
    program = folder / "runtime.py"
    program.write_text(f"{program.read_text()}\nTERMS['{function}'] = lambda i, term: i[0]\n")
    assert check_bundle(folder).is_passed
    edit_program(program, "-rotation(i[0])[2]", "rotation(i[0])[2]")
    assert check_bundle(folder).causes == ["opposite sign"]


@pytest.mark.parametrize("key", ["default_pos", "armature", "damping", "frictionloss"])
def test_joints_of_the_contract_are_those_of_the_scene(folder, key):
    edit_contract(folder, lambda content: content["joints"][2].update({key: 0.5}))
    finding = check_bundle(folder).as_dict()["findings"][0]
    assert finding["stage"] == "contract"
    assert finding["values"] == f"joints/{key}"
    assert finding["component"] == "FR_calf_joint"


def test_joints_are_listed_in_the_order_of_their_positions(folder):
    """Programs fill `joint_pos` in the order of the names."""

    def swap(content: dict[str, Any]) -> None:
        content["joints"].insert(0, content["joints"].pop(3))

    edit_contract(folder, swap)
    assert "joints/order" in str(check_bundle(folder))


def test_difference_of_the_state_is_of_a_joint(folder):
    edit_program(
        folder / "simulate.py",
        "before the last physics step.\n",
        "before the last physics step.\n        self.data.joint('robot/RR_calf_joint').qpos[0] += 1.0\n",
    )
    (finding,) = {one["component"] for one in check_bundle(folder).as_dict()["findings"]} - {None}
    assert finding == "robot/RR_calf_joint"


def test_sensor_that_is_left_out_differs(folder):
    edit_program(
        folder / "simulate.py",
        """if source["kind"] != "trace":""",
        """if measurement["name"] != "imu_ang_vel":""",
    )
    report = check_bundle(folder)
    # JSON has no NaN.
    json.dumps(report.as_dict(), allow_nan=False)
    wrong = {one.name for one in report.comparisons if not one.is_equal}
    assert "measurement/imu_ang_vel" in wrong
    assert {one.comparison.name for one in report.findings} == {"measurement/imu_ang_vel"}


def test_limits_of_geared_actuators_are_torques(bundle):
    evidence = Evidence(bundle("go1"))
    before = fitness_warnings(evidence), undecided(evidence)
    evidence = Evidence(bundle("go1"))
    evidence.model.actuator_gear[:, 0] *= 10.0
    evidence.trace["actuator_force"] = evidence.trace["actuator_force"] / 10.0
    assert (fitness_warnings(evidence), undecided(evidence)) == before


def test_modules_beside_a_program_are_found(folder, tmp_path):
    other = Path(shutil.copytree(folder, tmp_path / "other"))
    for place, sign in ((folder, "-"), (other, "")):
        (place / "my_terms.py").write_text(f"def gravity(up):\n    return {sign}up\n")
        program = place / "runtime.py"
        edit_program(program, "import numpy as np", "import my_terms\nimport numpy as np")
        edit_program(program, "-rotation(i[0])[2]", "my_terms.gravity(rotation(i[0])[2])")
    before = list(sys.path)
    assert check_bundle(folder).is_passed
    assert check_bundle(other).causes == ["opposite sign"]
    assert sys.path == before
    assert "my_terms" not in sys.modules


def test_program_that_raises_is_named(folder):
    (folder / "runtime.py").write_text("import no_such_module\n")
    with pytest.raises(UserError, match="no_such_module"):
        check_bundle(folder)
