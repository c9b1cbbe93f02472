"""Learning curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mjlab.rl.config import EvaluationCfg
from mjlab.rl.plot import (
    DEFAULT_TAG,
    LABELS,
    mean_and_std,
    picture_path,
    plot_curves,
    plot_run,
    plot_seeds,
    read_all_scalars,
    read_scalars,
    solved_at,
    visible_range,
)

EVALUATION = EvaluationCfg(solved_return=900.0)
WALK = EvaluationCfg(
    solved_below={"speed_error": 0.25, "failure_rate": 0.05},
    units={"speed_error": "m/s"},
    num_episodes=200,
)


def write_run(
    folder: Path,
    values: dict[int, float],
    tag: str = DEFAULT_TAG,
    others: dict[str, dict[int, float]] | None = None,
) -> Path:
    from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(str(folder))
    for name, curve in {tag: values, **(others or {})}.items():
        for iteration, value in curve.items():
            writer.add_scalar(name, value, iteration)
    writer.close()
    return folder


@pytest.fixture
def figures(monkeypatch) -> list:
    """Figures, as they are saved."""
    from matplotlib.figure import Figure

    saved = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *args, **kwargs: saved.append(self))
    return saved


def points_of(axes, label: str) -> list[tuple[float, float]]:
    (line,) = (line for line in axes.lines if line.get_label() == label)
    return [*zip(line.get_xdata(), line.get_ydata(), strict=True)]


def is_png(path: Path) -> bool:
    return path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_all_values_of_a_long_run_are_read(tmp_path: Path):
    run = write_run(tmp_path, {i: i / 2 for i in range(1500)})
    iterations, values = read_scalars(run, DEFAULT_TAG)
    assert iterations.tolist() == list(range(1500))
    assert np.array_equal(values, iterations / 2)


def test_mean_and_deviation_are_where_all_runs_have_data():
    one = (np.array([0, 2, 4]), np.array([0.0, 2.0, 4.0]))
    # Resumed at iteration 1, and solved after 2.
    other = (np.array([1, 2, 3]), np.array([3.0, 4.0, 5.0]))
    iterations, mean, std = mean_and_std([one, other])
    assert iterations.tolist() == [1, 2, 3]
    assert mean.tolist() == [2.0, 3.0, 4.0]
    # Of two values, the sample standard deviation is their distance over the root of two.
    assert std == pytest.approx(np.array([2.0, 2.0, 2.0]) / np.sqrt(2))
    assert mean_and_std([one])[2].tolist() == [0.0, 0.0, 0.0]
    later = (np.array([5, 6]), np.array([1.0, 1.0]))
    assert [part.tolist() for part in mean_and_std([one, later])] == [[], [], []]


def test_single_runs_are_drawn_beyond_the_mean(tmp_path: Path):
    seen = []
    short, long = (np.arange(4), np.ones(4)), (np.arange(8), np.zeros(8))
    plot_curves(
        {"a": [short, long]}, tmp_path / "x.png", title="", ylabel="", draw=seen.append
    )  # fmt: skip
    (axes,) = seen
    spans = [(line.get_xdata()[0], line.get_xdata()[-1]) for line in axes.lines]
    assert spans == [(0, 3), (3, 7)]
    assert axes.lines[0].get_linewidth() > axes.lines[1].get_linewidth()


def test_a_single_evaluation_is_seen(tmp_path: Path):
    seen = []
    one, other = (np.array([3]), np.array([1.0])), (np.array([4]), np.array([1.0]))
    plot_curves(
        {"a": [one], "b": [one, other]}, tmp_path / "x.png", title="", ylabel="", draw=seen.append
    )  # fmt: skip
    points = [line for line in seen[0].lines if len(line.get_xdata()) == 1]
    assert [line.get_marker() for line in points] == ["o", "o", "o"]


def test_one_run_and_several_seeds_become_pngs(tmp_path: Path):
    runs = [write_run(tmp_path / str(k), {i: i * k for i in range(4)}) for k in (1, 2)]
    assert is_png(plot_run(runs[0]))
    assert (runs[0] / "learning_curve.png").is_file()
    assert is_png(plot_seeds(runs, tmp_path / "new" / "seeds.png", title="Swing-up"))
    assert is_png(plot_seeds({"a": runs, "b": runs[:1]}, tmp_path / "two.png"))


def test_a_dollar_in_a_name_is_drawn_as_it_is(tmp_path: Path, figures):
    group = [(np.arange(3), np.arange(3.0))]
    for words in (r"$\nope$", "a_$x^2$"):
        plot_curves({words: group}, tmp_path / "a.png", title=words, ylabel=words)
        (legend,) = figures[-1].legends
        drawn = [legend.get_texts()[0], figures[-1].axes[0].yaxis.label]
        assert [text.get_text() for text in drawn] == [words, words]
        assert not any(text.get_parse_math() for text in drawn)


def test_a_picture_needs_a_name_and_a_known_ending(tmp_path: Path):
    assert picture_path(tmp_path / "a") == tmp_path / "a.png"
    for name in ("a.PNG", "a.pdf"):
        assert picture_path(tmp_path / name) == tmp_path / name
    curves = {"": [(np.arange(3), np.arange(3.0))]}
    with pytest.raises(ValueError, match=f"folder '{tmp_path}'"):
        plot_curves(curves, tmp_path, title="", ylabel="")
    with pytest.raises(ValueError, match=r"a\.nope.*png"):
        plot_curves(curves, tmp_path / "a.nope", title="", ylabel="")
    assert not list(tmp_path.iterdir())


def test_wrong_folders_tags_and_empty_lists_are_named(tmp_path: Path):
    with pytest.raises(ValueError, match="no TensorBoard event files in '.*empty'"):
        plot_run(tmp_path / "empty")
    run = write_run(tmp_path / "run", {0: 1.0})
    with pytest.raises(ValueError, match=f"'Train/nothing'.*{DEFAULT_TAG}"):
        plot_run(run, tag="Train/nothing")
    with pytest.raises(ValueError, match="at least one"):
        plot_seeds([], tmp_path / "none.png")


def test_one_outlier_does_not_hide_the_curve():
    curve = np.concatenate([np.linspace(0.0, 1.0, 60), [1e27], np.linspace(1.0, 2.0, 60)])
    low, high = visible_range(curve)
    assert -0.2 < low <= 0.1
    assert 1.9 <= high < 2.2


@pytest.mark.parametrize(
    "curve",
    [
        np.linspace(0.0, 1.0, 50),
        np.concatenate([np.zeros(95), np.full(5, 900.0)]),
        np.array([1.0, 1e9]),
        np.array([0.0, 10.0, 10.1, 20.0]),
        np.full(20, 3.0),
        np.array([]),
    ],
)
def test_what_a_curve_shows_stays_in_sight(curve):
    assert visible_range(curve) is None


def test_resumed_curves_have_one_value_an_iteration(tmp_path: Path):
    write_run(tmp_path, {0: 1.0, 1: 2.0, 2: 3.0, 3: 4.0})
    (first,) = tmp_path.iterdir()
    first.rename(tmp_path / "events.out.tfevents.0")
    write_run(tmp_path, {2: 30.0})
    iterations, values = read_scalars(tmp_path, DEFAULT_TAG)
    assert iterations.tolist() == [0, 1, 2]
    assert values.tolist() == [1.0, 2.0, 30.0]


@pytest.mark.parametrize("damage", ["flip", "truncate"])
def test_a_damaged_event_file_is_read_up_to_there_and_told(tmp_path: Path, caplog, damage):
    write_run(tmp_path, {k: float(k) for k in range(100)})
    (path,) = tmp_path.iterdir()
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    if damage == "flip":
        content[middle] ^= 1
    else:
        del content[middle:]
    assert len(read_scalars(tmp_path, DEFAULT_TAG)[0]) == 100
    assert not caplog.text
    path.write_bytes(content)
    iterations, values = read_scalars(tmp_path, DEFAULT_TAG)
    assert 30 < len(iterations) < 70
    assert values.tolist() == iterations.tolist()
    assert str(path) in caplog.text


EACH = "Perf/collection_time"


def test_the_parts_of_a_run_are_one_curve(tmp_path: Path):
    scores = "Evaluation/mean_return"
    first = {EACH: dict.fromkeys(range(6), 1.0), scores: {1: 10.0, 4: 40.0}}
    one = write_run(tmp_path / "1", dict.fromkeys(range(6), 1.0), others=first)
    # Killed after iteration 5, and resumed from the checkpoint after iteration 3.
    second = {EACH: dict.fromkeys(range(3, 8), 1.0), scores: {7: 70.0}}
    two = write_run(tmp_path / "2", dict.fromkeys(range(3, 8), 2.0), others=second)
    # Solved at its start.
    three = write_run(tmp_path / "3", {7: 77.0}, tag="Confirmation/mean_return")
    curves = read_all_scalars([one, two, three])
    assert curves[DEFAULT_TAG][0].tolist() == list(range(8))
    assert curves[DEFAULT_TAG][1].tolist() == [1.0] * 3 + [2.0] * 5
    assert curves[scores][0].tolist() == [1, 7]
    assert curves["Confirmation/mean_return"][1].tolist() == [77.0]
    # A policy of another tool was resumed.
    (tmp_path / "0").mkdir()
    assert read_scalars([tmp_path / "0", one], DEFAULT_TAG)[0].tolist() == list(range(6))


def test_the_learning_curve_has_goal_evaluations_and_units(tmp_path: Path, figures):
    others = {
        "Evaluation/mean_return": {2: 850.0, 4: 950.0},
        "Confirmation/mean_return": {4: 940.0},
        "Perf/total_fps": dict.fromkeys(range(5), 1000.0),
        EACH: dict.fromkeys(range(5), 1.5),
        "Perf/learning_time": dict.fromkeys(range(5), 0.5),
    }
    run = write_run(tmp_path, {i: 100.0 * i for i in range(5)}, others=others)
    plot_run(run, evaluation=EVALUATION)
    (figure,) = figures
    (axes,) = figure.axes
    assert points_of(axes, "exploring policy")[-1] == (5, 400.0)
    assert points_of(axes, "evaluation") == [(3, 850.0), (5, 950.0)]
    assert points_of(axes, "confirmation") == [(5, 940.0)]
    assert {y for _, y in points_of(axes, "goal")} == {900.0}
    assert axes.get_xlabel() == "Iteration"
    assert "sum of weighted rewards" in axes.get_ylabel()
    (above,) = axes.child_axes
    assert above.get_xlabel() == "Environment steps"
    figure.canvas.draw()
    low, high = axes.get_xlim()
    assert above.get_xlim() == pytest.approx((2000.0 * low, 2000.0 * high))


@pytest.mark.parametrize("goal", [1e9, float("inf"), float("nan")])
def test_a_goal_that_nothing_reaches_does_not_flatten_the_curve(tmp_path: Path, figures, goal):
    plot_run(write_run(tmp_path, {0: 1.0, 1: 2.0}), evaluation={"solved_return": goal})
    assert figures[0].axes[0].get_ylim()[1] < 3.0


def test_goals_besides_the_return_have_their_own_axes(tmp_path: Path, figures):
    others = {
        "Evaluation/mean_return": {1: 3000.0},
        "Train/speed_error": {0: 0.75, 1: 0.5},
        "Evaluation/speed_error": {1: 0.3},
        "Evaluation/failure_rate": {1: 0.1},
    }
    plot_run(write_run(tmp_path, {0: 1.0, 1: 2.0}, others=others), evaluation=WALK)
    _, error, failures = figures[0].axes
    assert error.get_title() == "Speed error (m/s)"
    assert points_of(error, "evaluation") == [(2, pytest.approx(0.3))]
    assert points_of(error, "exploring policy") == [(1, 0.75), (2, 0.5)]
    assert failures.get_title() == "Failure rate (%)"
    assert points_of(failures, "evaluation") == [(2, pytest.approx(10.0))]
    assert {y for _, y in points_of(failures, "goal")} == {5.0}


def test_seeds_are_drawn_with_what_solves_the_task(tmp_path: Path, figures):
    evaluation = EvaluationCfg(solved_below={"speed_error": 0.2}, units={"speed_error": "m/s"})
    runs = []
    for at in (2, 3):
        others = {"Train/speed_error": {0: 0.5, 4: 0.2}, "Evaluation/speed_error": {at: 0.1}}
        runs.append(write_run(tmp_path / str(at), {0: 1.0, 4: 2.0}, others=others))
    plot_seeds(runs, tmp_path / "seeds.png", evaluation=evaluation)
    _, errors = figures[0].axes
    assert errors.get_title() == "Speed error (m/s)"
    drawn = [line.get_xydata().tolist() for line in errors.lines[1:4:2]]
    assert drawn == [[[3.0, pytest.approx(0.1)]], [[4.0, pytest.approx(0.1)]]]
    assert {y for _, y in points_of(errors, "goal")} == {0.2}
    # Another tag is drawn alone.
    plot_seeds(runs, tmp_path / "seeds.png", tag=DEFAULT_TAG, evaluation=evaluation)
    assert len(figures[1].axes) == 1


@pytest.mark.parametrize("tag", ["Train/mean_step_reward", "Train/mean_reward"])
def test_runs_without_a_return_have_another_unit(tmp_path: Path, figures, tag):
    run = write_run(tmp_path, {0: 1.0, 1: 2.0}, tag=tag)
    plot_run(run, evaluation=EVALUATION)
    (axes,) = figures[0].axes
    assert axes.get_ylabel() == LABELS[tag]
    # A return is no goal of another unit.
    assert len(axes.lines) == 1
    plot_seeds([run, run], tmp_path / "seeds.png")
    assert figures[1].axes[0].get_ylabel() == LABELS[tag]


def test_a_run_is_solved_where_all_goals_are_met(tmp_path: Path):
    def curves(group: str, **values: list[float]):
        return {f"{group}/{k}": (np.arange(len(v)), np.array(v)) for k, v in values.items()}

    returns = [800.0, 910.0, 890.0, 920.0]
    to_the_end = EvaluationCfg(solved_return=900.0, stop_when_solved=False)
    assert solved_at(curves("Evaluation", mean_return=returns), to_the_end) == 2
    # Evaluations of runs that stop when solved are confirmed.
    assert solved_at(curves("Evaluation", mean_return=returns), EVALUATION) is None
    assert solved_at(curves("Confirmation", mean_return=returns), EVALUATION) == 2
    # 10 failures in 200 episodes count as 5.8 %, 8 as 4.9 %.
    walked = curves("Confirmation", speed_error=[0.3, 0.2, 0.2], failure_rate=[0.01, 0.05, 0.04])
    assert solved_at(walked, WALK) == 3
    assert solved_at(walked, EvaluationCfg()) is None
