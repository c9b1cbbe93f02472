"""Fits recover known drives, and say what a log cannot separate."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from swing import TRUE, link_spec, make_log

from mjlab.identification.estimate import LimbEstimate
from mjlab.identification.fit import jackknife
from mjlab.identification.log import JointLog
from mjlab.identification.plant import KINDS
from mjlab.identification.robot import Drives, fit_robot
from mjlab.utils.errors import UserError

DRIVES = Drives({"hinge0": 25.0}, {"hinge0": 1.3}, {})


def fit(mass: float, with_torque: bool) -> LimbEstimate:
    spec = link_spec(mass)
    return fit_robot(spec, DRIVES, [make_log(spec, with_torque)])[0]


def cut(log: JointLog, seconds: float) -> JointLog:
    """Return the first seconds of a log."""
    rows = round(seconds / log.period)
    signals = {name: getattr(log, name) for name in ("target", "position", "velocity", "torque")}
    kept = {name: signal[:rows] for name, signal in signals.items() if signal is not None}
    return dataclasses.replace(log, **kept)


@pytest.fixture(scope="module")
def with_torque() -> LimbEstimate:
    return fit(0.4, True)


@pytest.fixture(scope="module")
def without_torque() -> LimbEstimate:
    return fit(0.4, False)


def test_intervals_hold_the_true_drive(with_torque: LimbEstimate) -> None:
    drive = with_torque.drives[0]
    assert drive.remarks == ()
    for kind, true in zip(KINDS, TRUE, strict=False):
        estimate = drive.parameters[kind]
        assert abs(estimate.value - true) <= estimate.half_width, kind
        assert estimate.half_width < 0.15 * true, kind
    assert abs(with_torque.delay.value - TRUE[-1]) <= with_torque.delay.half_width < 0.003


def test_damping_and_kd_need_torques(without_torque: LimbEstimate) -> None:
    drive = without_torque.drives[0]
    assert drive.remarks[0].startswith("damping and kd only as their sum, 1.")
    assert not drive.parameters["damping"].is_known
    for kind in ("friction", "kp"):
        assert drive.parameters[kind].is_known
    total = drive.parameters["damping"].value + drive.parameters["kd"].value
    assert total == pytest.approx(TRUE[1] + TRUE[4], rel=0.05)


def test_a_bare_rotor_gives_ratios_only() -> None:
    drive = fit(1e-5, False).drives[0]
    assert any("only as ratios" in remark for remark in drive.remarks)
    assert not drive.parameters["kp"].is_known
    ratio = drive.parameters["armature"].value / drive.parameters["kp"].value
    assert ratio == pytest.approx(TRUE[0] / TRUE[3], rel=0.05)


def test_residuals_are_the_noise(with_torque: LimbEstimate) -> None:
    assert with_torque.rms["position"] == pytest.approx(5e-4, rel=0.1)
    assert with_torque.rms["torque"] == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize("seconds", [(0.48,), (5.2,), (3.0, 2.5), (6.0, 1.2)])
def test_short_logs_are_refused(seconds: tuple[float, ...]) -> None:
    """Intervals need the settling time of each log, and five windows of a second in all."""
    with pytest.raises(UserError, match=r"5\.3 s"):
        fit_robot(link_spec(), DRIVES, [cut(make_log(link_spec(), False), s) for s in seconds])


def test_five_windows_are_enough() -> None:
    spec = link_spec(0.4)
    limb = fit_robot(spec, DRIVES, [cut(make_log(spec, True), 5.3)])[0]
    assert all(np.isfinite(e.half_width) for e in limb.drives[0].parameters.values())


def test_missing_gains_are_named() -> None:
    spec = link_spec()
    with pytest.raises(UserError, match="--stiffness"):
        fit_robot(spec, Drives({}, {}, {}), [make_log(spec, False)])


def test_jackknife_of_a_line() -> None:
    """White residuals: twice the covariance of least squares; correlated ones: more."""
    rng = np.random.default_rng(0)
    jacobian = np.stack([np.ones(4000), np.linspace(-1.0, 1.0, 4000)], axis=1)
    windows = np.arange(4000) // 100
    white = rng.normal(size=4000)
    white -= jacobian @ np.linalg.lstsq(jacobian, white, rcond=None)[0]
    covariance, freedom = jackknife(jacobian, white, windows)
    expected = 2.0 * np.linalg.inv(jacobian.T @ jacobian)
    assert freedom == 39
    assert np.diag(covariance) == pytest.approx(np.diag(expected), rel=0.4)
    slow = np.repeat(rng.normal(size=40), 100)
    slow -= jacobian @ np.linalg.lstsq(jacobian, slow, rcond=None)[0]
    assert np.diag(jackknife(jacobian, slow, windows)[0]).min() > 10.0 * expected.min()
