"""Page of a policy: what it states, and that it needs nothing else."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import numpy as np
import pytest

from mjlab.rl.config import EvaluationCfg
from mjlab.runs import Run
from mjlab.runs.shared_page import SharedPage, learning_curves
from mjlab.viewer.viser.recording import Episode, Recording

NAN = float("nan")
RECORDING = Recording(
    html='<!doctype html><p title="a&amp;b">scene</p>',
    episodes=[Episode(0.0, 0.08, 3.0, ()), Episode(0.12, 0.04, 1.0, ("fell_over",))],
    times=[0.0, 0.04, 0.08, 0.12, 0.16],
    commands={"twist": [[0.0, 0.5]] * 5},
    rewards={"upright": [NAN, 1.0, 2.0, NAN, 1.0]},
    legend={"command": (0.0, 0.5, 1.0, 1.0)},
)
EVALUATION = {
    "num_episodes": 400,
    "seed": 7,
    "physics": "native",
    "mean_return": 12.0,
    "return_interval": [11.0, 13.0],
    "success_rate": None,
    "failure_rate": 0.0,
    "failure_interval": [0.0, 0.01],
    "metrics": {},
    "units": {},
}


def page(**changes) -> str:
    """Return the page with some content changed."""
    content = {
        "task": "Walk",
        "origin": {"policy": "model_9.pt", "commit": None},
        "recording": RECORDING,
        "reward_unit": 0.5,
        "command_names": {"twist": ["x (m/s)", "y (m/s)"]},
        "evaluation_command": "evaluate Walk --output evaluation.json",
    }
    return SharedPage(**{**content, **changes}).html()


class Tags(HTMLParser):
    """Attributes of the tags of a page, by tag."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))


def test_scene_is_in_the_page():
    (scene,) = [attrs["srcdoc"] for tag, attrs in Tags(page()).found if tag == "iframe"]
    assert scene == RECORDING.html


def test_nothing_is_loaded_from_elsewhere():
    for _, attrs in Tags(page(evaluation=EVALUATION)).found:
        assert not {"src", "href", "data", "action"} & attrs.keys()


def test_values_are_those_of_the_evaluation():
    text = page(evaluation=EVALUATION)
    for value in ("12", "11 to 13", "0.0 %", "0.0 to 1.0", "400 episodes, seed 7"):
        assert value in text
    assert "evaluation.json" not in text


def test_without_an_evaluation_the_command_is_shown():
    text = page()
    assert "evaluate Walk --output evaluation.json" in text
    assert "95 %" not in text


def test_episodes_have_returns_before_scaling_and_ends():
    text = page()
    assert "<td>6</td><td>end of the recording</td>" in text
    assert "<td>2</td><td>fell_over</td>" in text


def test_unknown_origins_are_named():
    assert "Not recorded: commit." in page()


def test_names_are_shown_as_they_are():
    hostile = "</title><script>alert(1)</script>"
    names = {"twist": [hostile, hostile]}
    recording = Recording(**{**vars(RECORDING), "legend": {hostile: (0.0, 0.0, 0.0, 1.0)}})
    text = page(task=hostile, origin={"policy": hostile}, command_names=names, recording=recording)
    assert hostile not in text
    assert "<script>alert" not in text


def test_runs_have_their_learning_curve(trained):
    goal = EvaluationCfg(solved_return=500.0)
    (chart,) = learning_curves(Run(trained), goal)
    assert "exploring policy" in chart
    assert "goal" in chart


def test_goals_span_the_training(trained, monkeypatch):
    """Also beside a single evaluation."""
    training = (np.arange(100.0), np.linspace(0.0, 1.0, 100))
    last = (np.array([99.0]), np.array([0.2]))
    curves = {"Train/exploring_return": training, "Evaluation/error": last}
    monkeypatch.setattr("mjlab.rl.plot.read_all_scalars", lambda run: curves)
    _, error = learning_curves(Run(trained), EvaluationCfg(solved_below={"error": 0.3}))
    dashed = re.search(r'd="M([\d.]+) [\d.]+L([\d.]+) [\d.]+" [^>]*stroke-dasharray', error)
    assert dashed is not None
    assert float(dashed[2]) - float(dashed[1]) > 300.0


def test_policies_without_training_have_no_curve(tmp_path):
    assert learning_curves(Run(tmp_path), EvaluationCfg()) == []
    assert "Not recorded: the policy comes without its training." in page()


@pytest.mark.parametrize("name", ["commands", "rewards"])
def test_tasks_may_lack_commands_and_rewards(name):
    recording = Recording(**{**vars(RECORDING), name: {}})
    text = page(recording=recording, command_names={})
    assert f"<h2>{name.capitalize()}</h2>" not in text or name == "rewards"
