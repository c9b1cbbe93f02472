"""Files written at the end of training."""

from __future__ import annotations

from functools import partial

import pytest
from commands import SMALL, TASK
from matplotlib.figure import Figure

from mjlab.cli.record import VideoCfg


def test_the_curve_of_a_resumed_run_is_whole(run, tmp_path, monkeypatch):
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *args, **kwargs: figures.append(self))
    flags = [*SMALL, "--log-root", str(tmp_path), "--agent.max-iterations"]
    assert run("train", TASK, *flags, "2").status == 0
    outcome = run("train", TASK, *flags, "3", "--agent.resume", "True")
    assert outcome.status == 0, outcome.err
    for figure, iterations in zip(figures, ([1, 2], [1, 2, 3]), strict=True):
        curve, goal = figure.axes[0].lines
        assert list(curve.get_xdata()) == iterations
        assert goal.get_ydata()[0] == pytest.approx(900.0)


def test_failures_beside_the_policy_are_warnings(run, tmp_path, monkeypatch):
    def fail(*args, **kwargs):
        raise OSError(28, "No space left on device")

    for name in ("rl.plot.plot_run", "cli.results.record_policy"):
        monkeypatch.setattr(f"mjlab.{name}", fail)
    flags = ("--log-root", str(tmp_path), "--agent.max-iterations", "1", "--result-video", "True")
    outcome = run("train", TASK, *SMALL, *flags)
    assert outcome.status == 0, outcome.err
    for name in ("learning curve", "video"):
        assert f"Not written: {name}: [Errno 28] No space left on device" in outcome.err
    assert len([*tmp_path.glob("cartpole/*/model_0.pt")]) == 1
    # The end of a run is one of them.
    monkeypatch.setattr("mjlab.scripts.train.write_info", fail_at_the_end)
    outcome = run("train", TASK, *SMALL, *flags[:-2])
    assert outcome.status == 0
    assert "end of the run in run.json: [Errno 28]" in outcome.err


def fail_at_the_end(run_dir, **info):
    if "ended" in info:
        raise OSError(28, "No space left on device")


@pytest.mark.parametrize(
    ("flags", "size"),
    [((), "640 x 360"), (("--env.viewer.width", "64", "--env.viewer.height", "48"), "64 x 48")],
)
def test_the_clip_of_a_result_is_announced(run, tmp_path, monkeypatch, flags, size):
    monkeypatch.setattr("mjlab.cli.results.VideoCfg", partial(VideoCfg, length=2))
    common = ("--log-root", str(tmp_path), "--agent.max-iterations", "1", "--result-video", "True")
    outcome = run("train", TASK, *SMALL, *common, *flags)
    assert outcome.status == 0, outcome.err
    announced = outcome.out.index(f"Recording a clip: 2 frames of {size} pixels")
    assert announced < outcome.out.index("Video:")
