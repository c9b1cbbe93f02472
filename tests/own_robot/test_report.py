"""Values of a task for the stock robots."""

from __future__ import annotations

import subprocess
import sys

import pytest

from mjlab.asset_zoo.robots.i2rt_yam.yam_constants import YAM_XML
from mjlab.asset_zoo.robots.unitree_g1.g1_constants import G1_XML
from mjlab.asset_zoo.robots.unitree_go1.go1_constants import GO1_XML
from mjlab.own_robot.report import describe_robot
from mjlab.utils.errors import UnknownNameError


@pytest.mark.parametrize(
    ("file", "kind", "feet"), [(GO1_XML, "legged", 4), (G1_XML, "legged", 2), (YAM_XML, "arm", 0)]
)
def test_kind(file, kind, feet):
    report = describe_robot(str(file))
    assert report.anatomy.kind.value == kind
    assert len(report.anatomy.feet.value) == feet


def test_settings_answer_questions():
    asked = describe_robot(str(GO1_XML))
    assert {question.key for question in asked.questions} >= {"effort", "armature"}
    settings = {"effort": "23.7", "armature": "0.004", "pose.FL_calf_joint": "-1.8"}
    report = describe_robot(str(GO1_XML), settings)
    assert set(report.effort.value.values()) == {23.7}
    assert report.effort.source == "set"
    assert report.joint_pos.value["FL_calf_joint"] == -1.8
    assert not {question.key for question in report.questions} & {"effort", "armature"}


def test_unknown_setting():
    with pytest.raises(UnknownNameError, match="did you mean 'effort'"):
        describe_robot(str(GO1_XML), {"efort": "1"})
    with pytest.raises(UnknownNameError, match="FL_calf_joint"):
        describe_robot(str(GO1_XML), {"effort.FL_kalf_joint": "1"})


def test_no_torch():
    code = "import sys, mjlab.own_robot.report; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
