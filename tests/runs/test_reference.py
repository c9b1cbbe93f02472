"""Reference runs: their curves over sessions, their files, and the band they give a new seed."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import stopped_after
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.rl.plot import read_scalars
from mjlab.runs import Run
from mjlab.runs.reference import (
    FALSE_ALARMS,
    Reference,
    RunRecord,
    SeedRecord,
    band,
    compare,
    read_run,
    reference_path,
    referenced_tasks,
    samples_limit,
    thinned,
)
from mjlab.utils.errors import UserError

# An evaluation after every iteration, of short episodes.
EVALUATED = (
    "--agent.evaluation.trigger-return", "-1e9", "--agent.evaluation.min-interval", "1",
    "--agent.evaluation.num-episodes", "4", "--env.episode-length-s", "0.1",
)  # fmt: skip


def curve(values, samples=None):
    values = np.asarray(values, dtype=float)
    return np.arange(1.0, len(values) + 1) if samples is None else np.asarray(samples), values


def run_record(values, samples=None, **changes) -> RunRecord:
    at, values = curve(values, samples)
    record = RunRecord(
        ended="solved",
        iterations=len(values),
        samples=int(at[-1]),
        seconds=float(len(values)),
        samples_at=[int(s) for s in at],
        seconds_at=[float(i + 1) for i in range(len(values))],
        figures={"mean_return": [float(v) for v in values]},
        num_episodes=16,
    )
    return dataclasses.replace(record, **changes)


def seed_record(seed: int, run: RunRecord, std_return: float = 0.0) -> SeedRecord:
    return SeedRecord(
        seed=seed,
        commit="0123abc",
        versions={"mujoco": "3.17.0"},
        machine={"cores": 2, "processor": "some", "gpu": None},
        minutes_limit=60.0,
        run=run,
        evaluation={"mean_return": run.figures["mean_return"][-1], "std_return": std_return},
    )


# The band.

VALUES = st.floats(-1e3, 1e3)
SEVERAL = st.integers(2, 5).flatmap(
    lambda count: st.lists(st.lists(VALUES, min_size=4, max_size=4), min_size=count, max_size=count)
)


@settings(max_examples=60)
@given(SEVERAL)
def test_the_seeds_of_a_reference_of_five_or_fewer_are_within_its_band(seeds):
    runs = [run_record(values) for values in seeds]
    for one in runs:
        # The rounding of a mean is more than nothing, where all are equal.
        assert compare(runs, one, standard_error=1e-9).within.all()


@settings(max_examples=60)
@given(SEVERAL, st.floats(0.1, 10.0), VALUES, st.floats(0.0, 100.0))
def test_the_band_has_the_units_of_the_curves(seeds, scale, shift, error):
    at = np.array([1.0, 1.5, 4.0, 9.0])
    mean, half = band([curve(values) for values in seeds], at, error)
    moved = [curve(scale * np.array(values) + shift) for values in seeds]
    moved_mean, moved_half = band(moved, at, scale * error)
    np.testing.assert_allclose(moved_mean, scale * mean + shift, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(moved_half, scale * half, rtol=1e-9, atol=1e-6)


@settings(max_examples=60)
@given(SEVERAL, st.floats(0.0, 100.0))
def test_the_band_is_never_narrower_than_an_evaluation_is_uncertain(seeds, error):
    curves, at = [curve(values) for values in seeds], np.array([1.0, 2.5])
    half = band(curves, at, error)[1]
    assert (half >= 1.96 * error).all()
    assert (half >= band(curves, at)[1]).all()


def test_the_width_is_that_of_a_prediction_interval():
    # Sample deviation 1; t with 2 degrees of freedom is 7.6489 at 1 - 1/120.
    mean, half = band([curve([4.0]), curve([5.0]), curve([6.0])], np.array([1.0]))
    assert mean == pytest.approx(5.0)
    assert half == pytest.approx(7.6489 * np.sqrt(4 / 3), rel=1e-3)


ALLOWED = FALSE_ALARMS + 3 * np.sqrt(FALSE_ALARMS * (1 - FALSE_ALARMS) / 1000)


@pytest.mark.parametrize("count", [3, 5])
@pytest.mark.parametrize("correlation", [0.0, 0.9, 1.0])
def test_few_healthy_seeds_are_called_outside(count, correlation):
    rng = np.random.default_rng(0)
    outside = 0
    for _ in range(1000):
        common = rng.normal(size=(count + 1, 1))
        own = rng.normal(size=(count + 1, 20))
        values = np.sqrt(correlation) * common + np.sqrt(1 - correlation) * own
        *seeds, new = [run_record(row, ended="finished") for row in values]
        outside += not compare(seeds, new, 0.0).is_within
    assert outside / 1000 <= ALLOWED


def learning(rng, speed: float = 1.0, spread: float = 0.4) -> RunRecord:
    """Return a run that is evaluated every 5 samples, and ends when its return is 900."""
    middle = 50.0 / speed * np.exp(spread * rng.normal())
    samples = np.arange(5.0, 5000.0, 5.0)
    values = 1000.0 * samples**3 / (samples**3 + middle**3) + rng.normal(0.0, 5.0, len(samples))
    (solved,) = np.nonzero(values >= 900.0)
    end = solved[0] + 1
    return run_record(values[:end], samples[:end], ended="solved")


@pytest.mark.parametrize("count", [3, 5])
def test_few_solved_seeds_are_called_outside(count):
    """Each is slower than all of the reference with a probability of one in count + 1."""
    rng = np.random.default_rng(0)
    outside = 0
    for _ in range(1000):
        *seeds, new = [learning(rng) for _ in range(count + 1)]
        outside += not compare(seeds, new, 5.0).is_within
    assert outside / 1000 <= ALLOWED


@pytest.mark.parametrize(("count", "speed"), [(3, 0.1), (5, 0.2)])
def test_seeds_that_learn_several_times_slower_are_mostly_found(count, speed):
    rng = np.random.default_rng(0)
    outside = 0
    for _ in range(200):
        seeds = [learning(rng, spread=0.2) for _ in range(count)]
        outside += not compare(seeds, learning(rng, speed, spread=0.2), 5.0).is_within
    assert outside / 200 > 0.9


RISING = np.linspace(0.0, 100.0, 20)
HEALTHY = [run_record(RISING + offset, ended="finished") for offset in (-2.0, 0.0, 2.0)]


@pytest.mark.parametrize(
    ("values", "is_within"),
    [
        (RISING + 5.0, True),
        (RISING + 40.0, False),
        (np.zeros(20), False),
        # Breakdown at the end only, or slow start only.
        (np.where(RISING < 90.0, RISING, 0.0), False),
        (np.where(RISING > 30.0, RISING, -50.0), True),
        (np.full(20, np.nan), False),
    ],
)
def test_a_curve_is_within_if_it_ends_there_and_is_there_half_of_the_way(values, is_within):
    run = run_record(values, ended="finished")
    assert compare(HEALTHY, run, 0.1).is_within == is_within


def test_a_run_that_was_solved_earlier_keeps_its_last_value():
    early = run_record([50.0, 101.0], samples=[2.0, 4.0], ended="solved")
    comparison = compare(HEALTHY, early, 0.1)
    assert comparison.samples[-1] == 20.0
    assert comparison.values[-1] == 101.0
    interrupted = dataclasses.replace(early, ended="interrupted")
    assert compare(HEALTHY, interrupted, 0.1).samples[-1] == 4.0


def test_where_all_were_solved_a_run_is_to_be_solved_in_time():
    solved = [run_record(RISING[:end], np.arange(end) + 1.0) for end in (10, 12, 14)]
    limit = samples_limit(solved)
    assert limit is not None
    # The way ends where the first was solved, because kept values are all alike.
    assert compare(solved, solved[2], 0.1).samples[-1] == 10.0
    for end, ended, is_within in ((13, "solved", True), (13, "finished", False)):
        run = run_record(RISING[:end], np.arange(end) + 1.0, ended=ended)
        assert compare(solved, run, 0.1).is_within == is_within
    late = dataclasses.replace(solved[0], samples=int(limit) + 1)
    assert not compare(solved, late, 0.1).is_within
    assert samples_limit([*solved, HEALTHY[0]]) is None


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("ends", [(10,), (7, 10)])
def test_with_one_or_two_seeds_a_run_is_to_be_solved_in_four_times_their_samples(ends, late):
    solved = [run_record(RISING[:end], np.arange(end) + 1.0) for end in ends]
    run = dataclasses.replace(
        run_record(np.array(RISING[:10]) - 900.0, np.arange(10) + 1.0),
        samples=4 * solved[-1].samples + late,
    )
    assert compare(solved, run, 0.1).is_within == (not late)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("ends", [(100.0,), (90.0, 110.0)])
def test_with_one_or_two_unsolved_seeds_a_run_is_to_end_with_half_of_their_return(ends, sign):
    """For two seeds, Student's t is 38: no run would be outside of a band."""
    seeds = [run_record([-500.0, sign * end], ended="minutes") for end in ends]
    for drop, error, is_within in ((0.49, 0.1, True), (0.51, 0.1, False), (0.51, 18.0, True)):
        run = run_record([-500.0, 100.0 * (sign - drop)], ended="finished")
        assert compare(seeds, run, error).is_within == is_within


@settings(max_examples=60)
@given(st.lists(st.integers(1, 10**6), min_size=1, max_size=5), st.integers(1, 1000))
def test_the_time_for_being_solved_is_more_than_any_took_and_scales(ends, scale):
    runs = [run_record([0.0, 1.0], [end, 2 * end], ended="solved") for end in ends]
    limit = samples_limit(runs)
    assert limit is not None
    assert 2 * max(ends) < limit <= 4 * 2 * max(ends) * (1 + 1e-9)
    scaled = [run_record([0.0, 1.0], [scale * end, 2 * scale * end]) for end in ends]
    assert samples_limit(scaled) == pytest.approx(scale * limit)


# Files.


@given(st.integers(1, 300), st.integers(2, 60))
def test_thinning_keeps_the_ends_and_changes_no_point(count, points):
    run = run_record(np.arange(count) ** 2)
    thin = thinned(run, points)
    assert len(thin.samples_at) == min(count, points)
    assert (thin.samples_at[0], thin.samples_at[-1]) == (run.samples_at[0], run.samples_at[-1])
    kept = set(zip(thin.samples_at, thin.seconds_at, thin.figures["mean_return"], strict=True))
    assert kept <= set(zip(run.samples_at, run.seconds_at, run.figures["mean_return"], strict=True))
    assert dataclasses.replace(
        thin, samples_at=run.samples_at, seconds_at=run.seconds_at, figures=run.figures
    ) == (run)


def test_a_reference_is_read_as_it_was_written(tmp_path):
    reference = Reference(task="A-Task.v1", kind="gpu", profile=None, flags=["--num-envs", "8"])
    for seed in (2, 1):
        reference.put(seed_record(seed, run_record([1.0, 2.5, seed])))
    path = reference.save(tmp_path)
    assert path == reference_path(tmp_path, "A-Task.v1", "gpu")
    assert Reference.load(path) == reference
    assert [seed.seed for seed in reference.seeds] == [1, 2]
    assert referenced_tasks(tmp_path) == {"A-Task.v1": ["gpu"]}
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_no_reference_is_named(tmp_path):
    for content in ("", "[]", "{}", '{"seeds": [{}]}'):
        (tmp_path / "x.json").write_text(content)
        with pytest.raises(UserError, match=r"x\.json: expected a reference"):
            Reference.load(tmp_path / "x.json")


def test_the_standard_error_is_of_one_evaluation_in_training():
    reference = Reference(task="T", kind="cpu", profile=None, flags=[])
    reference.put(seed_record(1, run_record([1.0], num_episodes=16), std_return=8.0))
    reference.put(seed_record(2, run_record([1.0], num_episodes=4), std_return=2.0))
    assert reference.standard_error == pytest.approx(np.sqrt((2.0**2 + 1.0**2) / 2))


# Curves of runs.


def times_dropped(run: RunRecord) -> RunRecord:
    return dataclasses.replace(run, seconds=0.0, seconds_at=[])


@pytest.fixture(scope="module")
def uninterrupted(train, tmp_path_factory) -> Path:
    return train(tmp_path_factory.mktemp("uninterrupted"), 4, *EVALUATED)


def test_the_evaluations_of_a_run_are_read_by_samples(uninterrupted):
    run = read_run(uninterrupted)
    assert (run.ended, run.iterations, run.samples) == ("finished", 4, 4 * 16 * 8)
    assert run.samples_at == [128, 256, 384, 512]
    assert run.num_episodes == 4
    assert {"mean_return", "failure_rate", "success_rate"} <= run.figures.keys()
    assert run.curve()[1] == pytest.approx(read_scalars(uninterrupted, "Evaluation/mean_return")[1])
    assert 0.0 < run.seconds_at[0] < run.seconds_at[-1] == run.seconds
    assert run.steps_per_second == run.samples / run.seconds


@pytest.mark.parametrize(
    "is_killed",
    [
        False,
        pytest.param(True, marks=pytest.mark.slow),
    ],
)
def test_a_resumed_run_has_the_curve_of_an_uninterrupted_one(
    train, uninterrupted, tmp_path, is_killed
):
    first = train(tmp_path, 3 if is_killed else 2, *EVALUATED)
    if is_killed:
        # Killed before this checkpoint: the third iteration is trained twice.
        (first / "model_2.pt").unlink()
    second = train(tmp_path, 3, *EVALUATED, "--agent.resume", "True")
    third = train(tmp_path, 4, *EVALUATED, "--agent.resume", "True")
    assert Run(third).info["resumed"] == f"{second.name}/model_2.pt"
    assert [run.folder for run in Run(third).joined] == [first, second, third]
    resumed, whole = read_run(third), read_run(uninterrupted)
    assert times_dropped(resumed) == times_dropped(whole)
    assert resumed.seconds > read_run(first).seconds_at[1]
    # A folder may be moved; a missing folder raises.
    moved = shutil.copytree(tmp_path, tmp_path.with_name(f"{tmp_path.name}_moved")) / "cartpole"
    assert read_run(moved / third.name) == resumed
    shutil.rmtree(moved / first.name)
    with pytest.raises(UserError, match=f"resumed: .*{first.name}"):
        read_run(moved / third.name)


def test_a_run_that_is_solved_as_it_is_resumed_has_its_last_evaluation(train, tmp_path):
    solved = (
        *EVALUATED,
        "--agent.evaluation.solved-return",
        "-1",
        "--agent.evaluation.min-interval",
        "2",
    )
    with stopped_after(2):
        first = train(tmp_path, 4, *solved, status=130)
    second = train(tmp_path, 4, *solved, "--agent.resume", "True")
    assert Run(first).info["ended"] == "interrupted"
    run = read_run(second)
    assert (run.ended, run.iterations, run.samples_at) == ("solved", 2, [256])


def test_a_run_without_evaluations_is_refused(trained):
    with pytest.raises(UserError, match="expected a run with evaluations"):
        read_run(trained)
