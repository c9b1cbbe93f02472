"""Learning curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mjlab.rl.plot import (
    DEFAULT_TAG,
    mean_and_std,
    plot_run,
    plot_seeds,
    read_scalars,
    visible_range,
)


def write_run(folder: Path, values: dict[int, float], tag: str = DEFAULT_TAG) -> Path:
    from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(str(folder))
    for iteration, value in values.items():
        writer.add_scalar(tag, value, iteration)
    writer.close()
    return folder


def is_png(path: Path) -> bool:
    return path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_all_values_of_a_long_run_are_read(tmp_path: Path):
    run = write_run(tmp_path, {i: i / 2 for i in range(1500)})
    iterations, values = read_scalars(run, DEFAULT_TAG)
    assert iterations.tolist() == list(range(1500))
    assert np.array_equal(values, iterations / 2)


def test_mean_and_deviation_are_over_all_runs_at_every_iteration():
    one = (np.array([0, 2, 4]), np.array([0.0, 2.0, 4.0]))
    # This run was solved after iteration 2, so it stays at its last value.
    other = (np.array([0, 1, 2]), np.array([0.0, 3.0, 4.0]))
    iterations, mean, std = mean_and_std([one, other])
    assert iterations.tolist() == [0, 1, 2, 4]
    assert mean.tolist() == [0.0, 2.0, 3.0, 4.0]
    # Of two values, the sample standard deviation is their distance over the root of two.
    assert std == pytest.approx(np.array([0.0, 2.0, 2.0, 0.0]) / np.sqrt(2))
    assert mean_and_std([one])[2].tolist() == [0.0, 0.0, 0.0]


def test_one_run_and_several_seeds_become_pngs(tmp_path: Path):
    runs = [write_run(tmp_path / str(k), {i: i * k for i in range(4)}) for k in (1, 2)]
    assert is_png(plot_run(runs[0]))
    assert (runs[0] / "learning_curve.png").is_file()
    assert is_png(plot_seeds(runs, tmp_path / "new" / "seeds.png", title="Swing-up"))
    assert is_png(plot_seeds({"a": runs, "b": runs[:1]}, tmp_path / "two.png"))


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


def test_a_run_that_was_resumed_before_its_end_has_one_value_for_each_iteration(tmp_path: Path):
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
