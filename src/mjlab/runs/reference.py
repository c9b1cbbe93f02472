"""Reference runs: learning curves of several seeds as JSON, and the prediction band of a new seed.

The files are bundled with the package, so that `verify` works without a checkout.
`benchmarks/reference.py` writes the files and their documentation page.
"""

from __future__ import annotations

import dataclasses
import json
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mjlab.runs import Run
from mjlab.runs.run import DONE
from mjlab.utils.errors import UserError
from mjlab.utils.logging import print_notice
from mjlab.utils.os import replacing

if TYPE_CHECKING:
    import numpy as np

    from mjlab.rl.plot import Curve

Kind = Literal["cpu", "gpu"]

DATA = Path(__file__).parents[1] / "reference"
"""Folder of the bundled references."""
METRIC = "mean_return"
"""Evaluation metric to compare. Every task has it, and learning increases it."""
FALSE_ALARMS = 0.05
"""Upper bound on the probability that a healthy seed is classified as outside."""
# Probability `a` of the bounds below. 3 a bounds the false alarms.
_TAIL = FALSE_ALARMS / 3
# Tag written once per iteration.
_EVERY_ITERATION = "Perf/collection_time"
# Points per stored curve: tens of kilobytes per task.
_POINTS = 60
# Number of comparison points, equally spaced in samples.
_GRID = 101
# Least seeds of a band: for two, t_1 = 38, and the band is wider than all returns.
_MIN_SEEDS = 3
# Upper bound of `samples_limit`, in multiples of the slowest seed's samples.
_MAX_SLOWDOWN = 4.0
# What a healthy seed may lack of the mean return in the end, without a band: a share, and standard errors.
_MAX_DROP, _MAX_ERRORS = 0.5, 3.0


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """Evaluations of a training run, over all sessions."""

    ended: str
    """Stop reason: `solved`, `finished` (last iteration), `minutes` (time limit), ..."""
    iterations: int
    """Number of finished iterations."""
    samples: int
    """Number of environment steps, over all environments."""
    seconds: float
    """Wall-clock time of collecting and learning (s), without evaluations."""
    samples_at: list[int]
    """Environment steps at each evaluation, (P,)."""
    seconds_at: list[float]
    """Wall-clock time at each evaluation (s), (P,)."""
    figures: dict[str, list[float]]
    """Evaluation metrics by name, each (P,)."""
    num_episodes: int
    """Number of episodes per evaluation."""

    @property
    def steps_per_second(self) -> float:
        """Environment steps per second of collecting and learning."""
        return self.samples / max(self.seconds, 1e-9)

    def curve(self, name: str = METRIC) -> Curve:
        """Return samples and the metric `name` of the evaluations, each (P,)."""
        import numpy as np

        return np.array(self.samples_at, dtype=float), np.array(self.figures[name], dtype=float)

    def curve_in_millions(self) -> Curve:
        """Return millions of samples and mean returns of the evaluations, each (P,)."""
        samples, values = self.curve()
        return samples / 1e6, values


@dataclass(frozen=True, kw_only=True)
class SeedRecord:
    """Training run of one seed."""

    seed: int
    """Seed of the training."""
    commit: str
    """Last commit that changed the code."""
    versions: dict[str, str]
    """Library versions that affect the results, by distribution name."""
    machine: dict[str, Any]
    """Machine: `cores`, `processor`, `gpu`."""
    minutes_limit: float
    """Training time limit (min)."""
    run: RunRecord
    """Training run."""
    evaluation: dict[str, Any]
    """Output of `evaluate --json True` for the last policy, on a seed not used for training."""


@dataclass(kw_only=True)
class Reference:
    """Training runs of a task with several seeds on a kind of device."""

    task: str
    """Name of the task."""
    kind: Kind
    """Kind of device."""
    profile: str | None
    """Profile of the task."""
    flags: list[str]
    """Further flags of `train`."""
    teacher: list[str] = dataclasses.field(default_factory=list)
    """Task and flags of `train` of the teacher, for a student."""
    seeds: list[SeedRecord] = dataclasses.field(default_factory=list)
    """Seeds, in ascending order."""

    @property
    def train_flags(self) -> list[str]:
        """Flags of `train` that reproduce a run, except the seed."""
        return [*(["--profile", self.profile] if self.profile else []), *self.flags]

    @property
    def usual_minutes(self) -> float | None:
        """Median time of collecting and learning until solved (min). None if a seed was not solved."""
        if not self.seeds or any(seed.run.ended != "solved" for seed in self.seeds):
            return None
        return statistics.median(seed.run.seconds for seed in self.seeds) / 60.0

    @property
    def standard_error(self) -> float:
        """Standard error of the mean return in one evaluation of a trained policy."""
        errors = [
            (seed.evaluation["std_return"] or 0.0) / math.sqrt(seed.run.num_episodes)
            for seed in self.seeds
        ]
        return math.sqrt(sum(error**2 for error in errors) / len(errors))

    def put(self, record: SeedRecord) -> None:
        """Add a seed, or replace the record of the same seed."""
        others = [seed for seed in self.seeds if seed.seed != record.seed]
        self.seeds = sorted([*others, record], key=lambda seed: seed.seed)

    def save(self, folder: Path) -> Path:
        """Write the reference into `folder` atomically; return the file."""
        path = reference_path(folder, self.task, self.kind)
        # Five significant digits and no indentation, to keep the file small.
        text = json.dumps(dataclasses.asdict(self))
        text = json.dumps(json.loads(text, parse_float=lambda x: float(f"{float(x):.5g}"))) + "\n"
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            file.write(text.encode())
        return path

    @classmethod
    def load(cls, path: Path) -> Reference:
        """Read what `save` wrote.

        Raises:
            UserError: the file is not a reference.
        """
        try:
            content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            for seed in content["seeds"]:
                seed["run"] = RunRecord(**seed["run"])
            content["seeds"] = [SeedRecord(**seed) for seed in content["seeds"]]
            return cls(**content)
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            raise UserError(
                f"{path}: expected a reference written by `make reference`, got {error!r}."
            ) from error


def reference_path(folder: Path, task: str, kind: Kind) -> Path:
    """Return the file of a reference in `folder`."""
    return folder / f"{task}.{kind}.json"


def referenced_tasks(folder: Path) -> dict[str, list[str]]:
    """Return the kinds of device with references in `folder`, by task."""
    tasks: dict[str, list[str]] = {}
    for path in sorted(folder.glob("*.json")):
        task, _, kind = path.stem.rpartition(".")
        tasks.setdefault(task, []).append(kind)
    return tasks


class NotEvaluatedError(UserError):
    """Run that ended before its first evaluation."""


def read_run(run_dir: Path) -> RunRecord:
    """Return the evaluations of the run in `run_dir` from its event files.

    If sessions overlap, because one was killed after its last checkpoint, the later session counts.

    Raises:
        NotEvaluatedError: the run was not evaluated.
        UserError: folder of an earlier session not found.
        ValueError: event files not found.
    """
    seconds, evaluations = _read_sessions(run_dir)
    if not evaluations:
        raise NotEvaluatedError(
            f"{run_dir}: expected a run with evaluations, got none; train longer, or set "
            "--agent.evaluation.solved-return and --agent.evaluation.trigger-return."
        )
    agent, env = Run(run_dir).params["agent"], Run(run_dir).params["env"]
    per_iteration = agent["num_steps_per_env"] * env["scene"]["num_envs"]
    # Metrics common to all evaluations; custom runners may add others.
    names = set.intersection(*(set(metrics) for metrics in evaluations.values()))
    evaluated = sorted(evaluations)
    elapsed = dict(
        zip(sorted(seconds), accumulate(seconds[i] for i in sorted(seconds)), strict=True)
    )
    last = max(seconds)
    return RunRecord(
        ended=Run(run_dir).state,
        iterations=last + 1,
        samples=(last + 1) * per_iteration,
        seconds=elapsed[last],
        samples_at=[(i + 1) * per_iteration for i in evaluated],
        seconds_at=[elapsed[i] for i in evaluated],
        figures={name: [evaluations[i][name] for i in evaluated] for name in sorted(names)},
        num_episodes=agent["evaluation"]["num_episodes"],
    )


def trained_seconds(run_dir: Path) -> float:
    """Return the time of collecting and learning of all sessions of a run (s)."""
    return sum(_read_sessions(run_dir)[0].values())


def _read_sessions(run_dir: Path) -> tuple[dict[int, float], dict[int, dict[str, float]]]:
    """Return iteration times (s) and evaluation metrics, by iteration from 0."""
    scalars = read_scalars_of_sessions(run_dir)
    learning = scalars.get("Perf/learning_time", {})
    collecting = scalars.get(_EVERY_ITERATION, {})
    seconds = {i: value + learning[i] for i, value in collecting.items()}
    evaluations: dict[int, dict[str, float]] = {}
    for tag, curve in scalars.items():
        group, _, name = tag.partition("/")
        if group == "Evaluation":
            for i, value in curve.items():
                evaluations.setdefault(i, {})[name] = value
    return seconds, evaluations


def read_scalars_of_sessions(run_dir: Path) -> dict[str, dict[int, float]]:
    """Return the values in the event files of all sessions of a run, by tag and iteration from 0.

    If sessions overlap, the later session counts.

    Raises:
        UserError: folder of an earlier session not found.
        ValueError: event files not found.
    """
    from mjlab.rl.plot import read_all_scalars

    # Steps of the other tags are seconds.
    return {
        tag: dict(zip(iterations.tolist(), values.tolist(), strict=True))
        for tag, (iterations, values) in read_all_scalars(
            [run.folder for run in Run(run_dir).joined]
        ).items()
        if not tag.endswith("/time")
    }


def parts_of(run_dir: Path) -> list[Path]:
    """Return the folders of a run that was resumed, from its first session to `run_dir`.

    If one was moved or deleted, only `run_dir`, with a notice.
    """
    try:
        return [run.folder for run in Run(run_dir).joined]
    except UserError as error:
        print_notice(str(error))
        return [run_dir]


def thinned(run: RunRecord, points: int = _POINTS) -> RunRecord:
    """Return `run` with at most `points` evaluations, including the first and the last."""
    count = len(run.samples_at)
    if count <= points:
        return run
    kept = sorted({round(i * (count - 1) / (points - 1)) for i in range(points)})
    return dataclasses.replace(
        run,
        samples_at=[run.samples_at[i] for i in kept],
        seconds_at=[run.seconds_at[i] for i in kept],
        figures={name: [values[i] for i in kept] for name, values in run.figures.items()},
    )


def band(
    curves: Sequence[Curve], at: np.ndarray, standard_error: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and half width of the prediction interval of a new curve, at samples `at` (P,).

    Given n seeds with mean m and sample standard deviation s, a new seed lies within

        m +- t_{n-1, 1-a/2} s sqrt(1 + 1/n)

    with probability 1 - a, if seeds are normally distributed. Student's t accounts for the uncertainty
    of s: for n = 3 and a = 1/60, t = 7.6 instead of 2.4 for the normal distribution. Seeds may agree
    by chance, so s is at least `standard_error`, that of one evaluation. For n < 3, the half width is
    infinite.
    """
    import numpy as np

    values = np.stack([np.interp(at, *curve) for curve in curves])
    mean = values.mean(axis=0)
    if len(curves) < _MIN_SEEDS:
        return mean, np.full_like(mean, np.inf)
    deviation = np.maximum(values.std(axis=0, ddof=1), standard_error)
    return mean, _width(len(curves), 1.0 - _TAIL / 2) * deviation


def samples_limit(runs: Sequence[RunRecord]) -> float | None:
    """Return the upper bound on the samples until a new seed is solved; None unless all `runs` were.

    The bound is the upper end of a one-sided prediction interval, as in `band`, for the logarithm of
    the samples, and at most four times the samples of the slowest seed, which is the bound of one or
    two seeds. The deviation is at least the distance between two evaluations.
    """
    import numpy as np

    if any(run.ended != "solved" for run in runs):
        return None
    most = _MAX_SLOWDOWN * max(run.samples for run in runs)
    if len(runs) < _MIN_SEEDS:
        return most
    logarithms = np.log([run.samples for run in runs])
    steps = [1.0 - (run.samples_at[-2:-1] or [0])[0] / run.samples_at[-1] for run in runs]
    deviation = max(logarithms.std(ddof=1), float(np.mean(steps)))
    limit = math.exp(logarithms.mean() + _width(len(runs), 1.0 - _TAIL) * deviation)
    return min(limit, most)


def _width(count: int, probability: float) -> float:
    """Return t_{n-1} sqrt(1 + 1/n), n = `count`: half width of a prediction interval in deviations."""
    from scipy.special import stdtrit

    return float(stdtrit(count - 1, probability)) * math.sqrt(1.0 + 1.0 / count)


@dataclass(frozen=True)
class Comparison:
    """Comparison of a run with the band of a reference, at P samples.

    The comparison ends with the shortest reference run: later values are constant, so that their band
    would be too narrow.
    """

    samples: np.ndarray
    """Samples, equally spaced, (P,)."""
    values: np.ndarray
    """Values of the run, (P,)."""
    mean: np.ndarray
    """Center of the band, (P,)."""
    half: np.ndarray
    """Half width of the band, (P,)."""
    limit: float | None
    """Maximum number of samples until solved. None: the run must end in the band, not below `least`."""
    least: float
    """Least return in the end. -inf if the reference has a band."""
    solved_at: int | None
    """Number of samples until solved. None: not solved."""

    @property
    def has_band(self) -> bool:
        """True if the reference has three seeds or more."""
        return bool(self.half[0] < math.inf)

    @property
    def within(self) -> np.ndarray:
        """True where the run is within the band, (P,) bool. False for NaN."""
        return abs(self.values - self.mean) <= self.half

    @property
    def ends_within(self) -> bool:
        """True if solved within `limit`; for `limit` None, if the last point is in the band.

        Without a band, if it is not below `least`.
        """
        if self.limit is None:
            return bool(self.within[-1] and self.values[-1] >= self.least)
        return self.solved_at is not None and self.solved_at <= self.limit

    @property
    def is_within(self) -> bool:
        """True if the run ends within, and at least half of its points are in the band.

        With three seeds or more, a healthy seed is outside with probability at most `FALSE_ALARMS` = 3 a,
        for any dependence between the points of a curve: the expected fraction of points outside is a,
        so the fraction exceeds 1/2 with probability at most 2 a (Markov), and the run ends outside with
        probability a.
        """
        return self.ends_within and bool(self.within.mean() >= 0.5)


def compare(runs: Sequence[RunRecord], run: RunRecord, standard_error: float) -> Comparison:
    """Return the comparison of `run` with the `runs` of a reference.

    A run solved before the end of the reference keeps its last value. An unfinished run is compared up
    to its last evaluation.
    """
    import numpy as np

    curves, curve = [one.curve() for one in runs], run.curve()
    begin = max(samples[0] for samples, _ in (*curves, curve))
    end = min(samples[-1] for samples, _ in curves)
    if run.ended not in DONE:
        end = min(end, curve[0][-1])
    samples = np.linspace(begin, max(begin, end), _GRID)
    mean, half = band(curves, samples, standard_error)
    drop = max(_MAX_DROP * abs(mean[-1]), _MAX_ERRORS * standard_error)
    return Comparison(
        samples=samples,
        values=np.interp(samples, *curve),
        mean=mean,
        half=half,
        limit=samples_limit(runs),
        least=-math.inf if len(runs) >= _MIN_SEEDS else float(mean[-1] - drop),
        solved_at=run.samples if run.ended == "solved" else None,
    )
