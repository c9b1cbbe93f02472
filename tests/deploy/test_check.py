"""The check of a bundle as it is written, and what it reports."""

from __future__ import annotations

import json

import pytest

from mjlab.deploy.check import TOLERANCES, check_bundle
from mjlab.utils.errors import UserError

BUNDLES = (
    "go1",
    "g1",
    "Mjlab-Cartpole-Swingup",
    "Mjlab-Tracking-Flat-Unitree-G1",
    "Mjlab-Lift-Cube-Yam",
    "Mjlab-Reach-Yam",
    "Mjlab-Velocity-Rough-Unitree-Go1",
    "Mjlab-Lift-Cube-Yam-Depth",
)


@pytest.mark.parametrize("name", BUNDLES)
def test_bundle_as_written_passes(bundle, name):
    report = check_bundle(bundle(name))
    assert report.is_passed, str(report)
    assert [one.stage for one in report.comparisons] == sorted(
        (one.stage for one in report.comparisons), key=list(TOLERANCES).index
    )
    # All stages, for all robots.
    assert {one.stage for one in report.comparisons} == set(TOLERANCES)


def test_report_says_where_and_why(bundle, tmp_path):
    folder = tmp_path / "bundle"
    folder.mkdir()
    for path in bundle("go1").iterdir():
        (folder / path.name).symlink_to(path)
    content = json.loads((folder / "contract.json").read_text())
    terms = content["observations"][0]["terms"]
    next(term for term in terms if term["name"] == "joint_pos")["offset"] = None
    (folder / "contract.json").unlink()
    (folder / "contract.json").write_text(json.dumps(content))
    report = check_bundle(folder)
    assert "term, raw/obs/joint_pos: first difference in step 0, " in str(report)
    assert "_calf_joint" in str(report)
    assert "Likely cause: default pose not subtracted." in str(report)
    (finding,) = report.as_dict()["findings"]
    assert finding["stage"] == "term"
    assert finding["cause"] == "default pose not subtracted"
    # Stages that start from the trace are equal all the same.
    equal = {one.stage for one in report.comparisons if one.is_equal}
    assert equal >= {"sensors", "torque", "state", "next sensors"}


def test_program_that_raises_is_named(bundle, tmp_path):
    folder = tmp_path / "bundle"
    folder.mkdir()
    for path in bundle("go1").iterdir():
        (folder / path.name).symlink_to(path)
    (folder / "runtime.py").unlink()
    (folder / "runtime.py").write_text("import no_such_module\n")
    with pytest.raises(UserError, match="no_such_module"):
        check_bundle(folder)
