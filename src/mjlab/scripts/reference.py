"""Reference runs: learning curves of several seeds as JSON, and the band they give a new seed.

The files ship with the package, so that `verify` works without a checkout. `benchmarks/reference.py`
makes them, and the page of the documentation from them.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mjlab.scripts.run_folder import read_agent_params, read_env_params, read_run_info, sessions_of
from mjlab.utils.errors import UserError
from mjlab.utils.os import replacing

if TYPE_CHECKING:
    import numpy as np

    from mjlab.rl.plot import Curve

Kind = Literal["cpu", "gpu"]

DATA = Path(__file__).parents[1] / "reference"
"""Folder of the references that ship with the package."""
FIGURE = "mean_return"
"""Figure of evaluations that is compared: the one that every task has, and that learning raises."""
FALSE_ALARMS = 0.05
"""Upper bound on the probability that a healthy seed is called outside."""
# Probability `a` of the bounds below. Three times that is the bound on false alarms.
_TAIL = FALSE_ALARMS / 3
ENDED = ("solved", "finished")
"""Reasons of the end after which nothing is left to train."""
# Points of a curve that are kept, and significant digits: tens of kilobytes a task.
_POINTS = 60
_DIGITS = 5
# Points, equally spaced in samples, at which a curve is compared.
_GRID = 101
# Upper bound of `samples_limit`, in multiples of the slowest seed's samples.
_PATIENCE = 4.0


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """Evaluations of a training run, over all of its sessions."""

    ended: str
    """Reason of the end: `solved`, `finished` (last iteration), `minutes` (time limit), ..."""
    iterations: int
    """Iterations finished."""
    samples: int
    """Environment steps, over all environments."""
    seconds: float
    """Wall-clock time of collecting and learning (s), without evaluations."""
    samples_at: list[int]
    """Environment steps at each evaluation, (P,)."""
    seconds_at: list[float]
    """Seconds at each evaluation, (P,)."""
    figures: dict[str, list[float]]
    """Figures of the evaluations by name, each (P,)."""
    num_episodes: int
    """Episodes of each evaluation."""

    @property
    def steps_per_second(self) -> float:
        """Environment steps per second of collecting and learning."""
        return self.samples / max(self.seconds, 1e-9)

    def curve(self, name: str = FIGURE) -> Curve:
        """Return samples and a figure of the evaluations, each (P,)."""
        import numpy as np

        return np.array(self.samples_at, dtype=float), np.array(self.figures[name], dtype=float)

    def curve_in_millions(self) -> Curve:
        """Return millions of samples and mean returns of the evaluations, each (P,)."""
        samples, values = self.curve()
        return samples / 1e6, values


@dataclass(frozen=True, kw_only=True)
class SeedRecord:
    """A seed of a reference."""

    seed: int
    """Seed of the training."""
    commit: str
    """Last commit that changed the code."""
    versions: dict[str, str]
    """Versions of the libraries that the figures depend on, by name of the distribution."""
    machine: dict[str, Any]
    """Machine: `cores`, `processor`, `gpu`."""
    minutes_limit: float
    """Minutes of training after which the run was to end."""
    run: RunRecord
    """The training."""
    evaluation: dict[str, Any]
    """Output of `evaluate --json True` for the last policy, on a seed that was not trained with."""


@dataclass(kw_only=True)
class Reference:
    """A task, trained with several seeds on a kind of device."""

    task: str
    """Name of the task."""
    kind: Kind
    """Kind of device."""
    profile: str | None
    """Profile of the task."""
    flags: list[str]
    """Further flags of `train`."""
    seeds: list[SeedRecord] = dataclasses.field(default_factory=list)
    """Seeds, in ascending order."""

    @property
    def train_flags(self) -> list[str]:
        """Flags of `train` that repeat a seed, but for the seed."""
        return [*(["--profile", self.profile] if self.profile else []), *self.flags]

    @property
    def standard_error(self) -> float:
        """Standard error of the return in one evaluation of a trained policy."""
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
        """Write the reference into `folder`, whole or not at all; return the file."""
        path = reference_path(folder, self.task, self.kind)
        # Not indented: smaller, and not meant to be read.
        text = json.dumps(_rounded(dataclasses.asdict(self))) + "\n"
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
            content: dict[str, Any] = json.loads(path.read_text())
            for seed in content["seeds"]:
                seed["run"] = RunRecord(**seed["run"])
            content["seeds"] = [SeedRecord(**seed) for seed in content["seeds"]]
            return cls(**content)
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            raise UserError(
                f"{path}: expected a reference, as `make reference` writes it, got {error!r}."
            ) from error


def reference_path(folder: Path, task: str, kind: Kind) -> Path:
    """Return the file of a reference in `folder`."""
    return folder / f"{task}.{kind}.json"


def referenced_tasks(folder: Path) -> dict[str, list[str]]:
    """Return the tasks that have references in `folder`, and on which kinds of device."""
    tasks: dict[str, list[str]] = {}
    for path in sorted(folder.glob("*.json")):
        task, _, kind = path.stem.rpartition(".")
        tasks.setdefault(task, []).append(kind)
    return tasks


class NotEvaluatedError(UserError):
    """Raised for a run that ended before its first evaluation."""


def read_run(run_dir: Path) -> RunRecord:
    """Return the evaluations of the run in `run_dir` from its event files.

    Where sessions overlap, because one was killed after its last checkpoint, the later one counts.

    Raises:
        NotEvaluatedError: the run was not evaluated.
        UserError: the folder of an earlier session is gone.
        ValueError: there are no event files.
    """
    seconds, evaluations = _read_sessions(run_dir)
    if not evaluations:
        raise NotEvaluatedError(
            f"{run_dir}: expected a run with evaluations, got none; train longer, or set "
            "--agent.evaluation.solved-return and --agent.evaluation.trigger-return."
        )
    agent, env = read_agent_params(run_dir), read_env_params(run_dir)
    per_iteration = agent["num_steps_per_env"] * env["scene"]["num_envs"]
    # Figures that all evaluations have; a task's own runner may add others.
    names = set.intersection(*(set(figures) for figures in evaluations.values()))
    evaluated = sorted(evaluations)
    passed = dict(
        zip(sorted(seconds), accumulate(seconds[i] for i in sorted(seconds)), strict=True)
    )
    last = max(seconds)
    return RunRecord(
        ended=str(end_of(run_dir)),
        iterations=last + 1,
        samples=(last + 1) * per_iteration,
        seconds=passed[last],
        samples_at=[(i + 1) * per_iteration for i in evaluated],
        seconds_at=[passed[i] for i in evaluated],
        figures={name: [evaluations[i][name] for i in evaluated] for name in sorted(names)},
        num_episodes=agent["evaluation"]["num_episodes"],
    )


def end_of(run_dir: Path) -> str | None:
    """Return why a run ended: `finished` too where Ctrl-C came in its last iteration; None if unknown."""
    info = read_run_info(run_dir)
    ended = info.get("ended")
    if (
        ended == "interrupted"
        and info["iterations"] >= read_agent_params(run_dir)["max_iterations"]
    ):
        return "finished"
    return ended


def trained_seconds(run_dir: Path) -> float:
    """Return the time of collecting and learning of all sessions of a run (s), evaluated or not."""
    return sum(_read_sessions(run_dir)[0].values())


def _read_sessions(run_dir: Path) -> tuple[dict[int, float], dict[int, dict[str, float]]]:
    """Return the seconds of iterations, and the figures of evaluations, by iteration from 0."""
    from mjlab.rl.plot import read_all_scalars

    seconds: dict[int, float] = {}
    evaluations: dict[int, dict[str, float]] = {}
    for session in sessions_of(run_dir):
        curves = read_all_scalars(session)
        # A session that was solved as it began has evaluations only.
        if "Perf/collection_time" in curves:
            iterations, collecting = curves["Perf/collection_time"]
            learning = curves["Perf/learning_time"][1]
            first = int(iterations[0])
            seconds = {i: value for i, value in seconds.items() if i < first}
            evaluations = {i: value for i, value in evaluations.items() if i < first}
            seconds |= dict(zip(iterations.tolist(), (collecting + learning).tolist(), strict=True))
        for tag, (iterations, values) in curves.items():
            group, _, name = tag.partition("/")
            if group == "Evaluation":
                for i, value in zip(iterations.tolist(), values.tolist(), strict=True):
                    evaluations.setdefault(i, {})[name] = value
    return seconds, evaluations


def thinned(run: RunRecord, points: int = _POINTS) -> RunRecord:
    """Return `run` with at most `points` evaluations, the first and the last among them."""
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
    """Return mean and half width of the prediction interval for one more curve, at samples `at` (P,).

    Of n seeds with mean m and sample deviation s, a further one lies within

        m +- t_{n-1, 1-a/2} s sqrt(1 + 1/n)

    with probability 1 - a, if seeds are normally distributed. Student's t makes up for s itself being
    uncertain: for n = 3 and a = 1/60 it is 7.6, where the normal distribution has 2.4. Seeds agree
    by chance now and then, so s is not taken for less than `standard_error`, that of one evaluation.

    Raises:
        ValueError: there are fewer than two curves, which have no deviation.
    """
    import numpy as np

    if len(curves) < 2:
        raise ValueError(
            f"reference seeds: expected at least 2, got {len(curves)}; train more of them."
        )
    values = np.stack([np.interp(at, *curve) for curve in curves])
    deviation = np.maximum(values.std(axis=0, ddof=1), standard_error)
    return values.mean(axis=0), _width(len(curves), 1.0 - _TAIL / 2) * deviation


def samples_limit(runs: Sequence[RunRecord]) -> float | None:
    """Return the samples within which a further seed is solved; None unless all `runs` were.

    It is the upper end of a one-sided prediction interval, as in `band`, for the logarithm of the
    samples, and at most four times what the slowest seed took. The deviation is not taken for less
    than what lies between two evaluations.
    """
    import numpy as np

    if any(run.ended != "solved" for run in runs):
        return None
    logarithms = np.log([run.samples for run in runs])
    steps = [1.0 - (run.samples_at[-2:-1] or [0])[0] / run.samples_at[-1] for run in runs]
    deviation = max(logarithms.std(ddof=1), float(np.mean(steps)))
    limit = math.exp(logarithms.mean() + _width(len(runs), 1.0 - _TAIL) * deviation)
    return min(limit, _PATIENCE * max(run.samples for run in runs))


def _width(count: int, probability: float) -> float:
    """Return t_{n-1} sqrt(1 + 1/n) for `count` n: the end of a prediction interval in deviations."""
    from scipy.special import stdtrit

    return float(stdtrit(count - 1, probability)) * math.sqrt(1.0 + 1.0 / count)


@dataclass(frozen=True)
class Comparison:
    """A run and the band of a reference, at P samples.

    Compared up to the end of the shortest reference run: later values are constant, so that their band
    would be too narrow.
    """

    samples: np.ndarray
    """Samples, equally spaced, (P,)."""
    values: np.ndarray
    """The curve, (P,)."""
    mean: np.ndarray
    """Middle of the band, (P,)."""
    half: np.ndarray
    """Half width of the band, (P,)."""
    limit: float | None
    """Samples within which the run is to be solved; None: where it is to end in the band."""
    solved_at: int | None
    """Samples after which the run was solved; None if it was not."""

    @property
    def within(self) -> np.ndarray:
        """True where the curve is within the band, (P,) bool. NaN is not."""
        return abs(self.values - self.mean) <= self.half

    @property
    def ends_within(self) -> bool:
        """True if solved within `limit`; where that is None, if the last point is in the band."""
        if self.limit is None:
            return bool(self.within[-1])
        return self.solved_at is not None and self.solved_at <= self.limit

    @property
    def is_within(self) -> bool:
        """True if the run ends within, and is in the band for at least half of the way.

        A healthy seed is outside with a probability of at most `FALSE_ALARMS` = 3 a, however the
        points of a curve depend on each other: the part of its way that lies outside is a on average,
        so that it is over 1/2 with a probability of at most 2 a (Markov), and it ends outside with a
        probability of a.
        """
        return self.ends_within and bool(self.within.mean() >= 0.5)


def compare(runs: Sequence[RunRecord], run: RunRecord, standard_error: float) -> Comparison:
    """Return the comparison of `run` with the `runs` of a reference.

    A run that was solved before the end of the way keeps its last value. One that has not ended is
    compared as far as it got.
    """
    import numpy as np

    curves, curve = [one.curve() for one in runs], run.curve()
    begin = max(samples[0] for samples, _ in (*curves, curve))
    end = min(samples[-1] for samples, _ in curves)
    if run.ended not in ENDED:
        end = min(end, curve[0][-1])
    samples = np.linspace(begin, max(begin, end), _GRID)
    mean, half = band(curves, samples, standard_error)
    return Comparison(
        samples=samples,
        values=np.interp(samples, *curve),
        mean=mean,
        half=half,
        limit=samples_limit(runs),
        solved_at=run.samples if run.ended == "solved" else None,
    )


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}")
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(item) for item in value]
    return value
