"""Training progress: the values that decide, beside their bounds.

`TrainingProgress` collects what observers receive. It renders as a panel (rich, without borders),
as a line for log files, and as the sentences that end a run. `NotebookProgress` shows the panel in one
output of a notebook; `mjlab.cli.display` shows it in terminals.
"""

from __future__ import annotations

import io
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from mjlab.rl.config import EvaluationCfg
from mjlab.rl.evaluation import Bound, EvaluationResult, curricula_text
from mjlab.rl.run_logger import IterationStats, TrainingObserver
from mjlab.utils.string import clock, counted, duration, escaped, number

if TYPE_CHECKING:
    from mjlab.rl.runner import MjlabOnPolicyRunner

# Updates of a notebook's output take some milliseconds.
_SECONDS_BETWEEN_OUTPUTS = 0.5
_NOTEBOOK_WIDTH = 90
_BARS, _ASCII_BARS = "▁▂▃▄▅▆▇█", "_.-=+*%#"
_READINGS, _MOST_READINGS = 24, 480
# Units of exploring episodes, and of endless ones.
_UNITS = ("return", "reward per step")
_ENDS = {"solved": "Finished", "finished": "Finished", "interrupted": "Interrupted"}


@dataclass(frozen=True, kw_only=True)
class ProgressCfg:
    """Facts about a run that its progress is compared with."""

    title: str = "Training"
    """First line: the task and the number of environments."""
    evaluation: EvaluationCfg
    """Conditions of a solved task."""
    step_seconds: float | None = None
    """Duration of an environment step (s)."""
    episode_steps: float | None = None
    """Time limit of episodes, in environment steps."""
    usual_iteration: int | None = None
    """Iteration at which reference runs of this task were solved. None: unknown."""

    @staticmethod
    def of_runner(
        runner: MjlabOnPolicyRunner, title: str = "Training", usual_iteration: int | None = None
    ) -> ProgressCfg:
        """Return the facts about the run of `runner`."""
        env = runner.env
        return ProgressCfg(
            title=f"{title}, {counted(env.num_envs, 'environment')}",
            evaluation=EvaluationCfg.of(runner.cfg.get("evaluation")),
            step_seconds=getattr(env.unwrapped, "step_dt", None),
            episode_steps=getattr(env, "max_episode_length", None),
            usual_iteration=usual_iteration,
        )


class TrainingProgress(TrainingObserver):
    """State of a training run. Renders as a panel of rich; `line` and `ending` are plain text."""

    shows_progress = True

    def __init__(self, cfg: ProgressCfg) -> None:
        self.stats: IterationStats | None = None
        """Statistics of the last iteration."""
        self.ended: str | None = None
        """Stop reason, once training has ended."""
        self._cfg = cfg
        self._bounds = Bound.all_of(cfg.evaluation)
        # Iteration and result of the last evaluations, the newest last.
        self._evaluations: list[tuple[int, EvaluationResult]] = []
        # Exploring return of every `_stride`-th iteration.
        self._returns: list[float] = []
        self._stride = 1
        self._first = self._total = 0
        self._started = time.perf_counter()
        # Duration of this session (s), once it has ended.
        self._spent = 0.0

    def on_start(self, first_iteration: int, total_iterations: int) -> None:
        """Start the clock."""
        self.stats, self.ended = None, None
        self._evaluations, self._returns, self._stride = [], [], 1
        self._first, self._total = first_iteration, total_iterations
        self._started = time.perf_counter()

    def on_iteration(self, stats: IterationStats) -> None:
        """Keep the statistics."""
        self.stats = stats
        if stats.iteration % self._stride == 0:
            self._returns.append(self._exploring(stats))
        if len(self._returns) > _MOST_READINGS:
            # Drawn several times per second, so the work must not grow with the run.
            self._returns, self._stride = self._returns[1::2], 2 * self._stride

    def on_evaluation(self, iteration: int, result: EvaluationResult, solved: bool) -> None:
        """Keep the result, and the one before for trends."""
        self._evaluations = [*self._evaluations[-1:], (iteration, result)]

    def on_confirmation(self, iteration: int, result: EvaluationResult, solved: bool) -> None:
        """Replace the result of the evaluation that it confirms or not."""
        self._evaluations[-1:] = [(iteration, result)]

    def on_end(self, reason: str) -> None:
        """Keep the stop reason and the time."""
        self._spent = self.spent
        self.ended = reason

    # Values.

    @property
    def iteration(self) -> int:
        """Number of finished iterations."""
        return self._first if self.stats is None else self.stats.iteration

    @property
    def spent(self) -> float:
        """Duration of this session (s)."""
        return time.perf_counter() - self._started if self.ended is None else self._spent

    @property
    def left_at_most(self) -> float | None:
        """Time until the last iteration (s), None if unknown: `IterationStats.time_left`."""
        return None if self.stats is None else self.stats.time_left

    @property
    def usual_end(self) -> tuple[int, float | None] | None:
        """Iteration at which the task is usually solved, and the time until then (s, None if unknown).

        None if that iteration is unknown or over.
        """
        usual, left = self._cfg.usual_iteration, self.left_at_most
        if usual is None or not self.iteration < usual <= self._total:
            return None
        share = (usual - self.iteration) / (self._total - self.iteration)
        return usual, None if left is None else share * left

    @property
    def solved_return(self) -> float | None:
        """Return of evaluations that solves the task, None if other values decide."""
        return next((b.limit for b in self._bounds if b.name == "mean_return"), None)

    @staticmethod
    def _exploring(stats: IterationStats) -> float:
        """Return the return of exploring episodes, the reward per step if episodes are endless."""
        value = stats.exploring_return
        return stats.mean_step_reward if value is None else value

    def _state(self, bound: Bound) -> str:
        """Return `met`, or the trend of the last two evaluations."""
        *earlier, (_, result) = self._evaluations
        if bound.is_met(result):
            return "met"
        if not earlier:
            return "not met"
        now, before = result.judged(bound.name), earlier[0][1].judged(bound.name)
        return "rising" if now > before else "falling" if now < before else "not met"

    def _next_evaluation(self) -> str | None:
        """Return when the policy is evaluated next, None if nothing solves the task."""
        if not self._bounds or self.stats is None:
            return None
        cfg, stats, steps = self._cfg.evaluation, self.stats, self._cfg.episode_steps or 0.0
        last = self._evaluations[-1][0] if self._evaluations else 0
        if cfg.is_triggered(stats.mean_step_reward, steps, stats.exploring):
            return f"at iteration {max(cfg.earliest_after(last), self.iteration + 1)}"
        for name, most in cfg.trigger_below.items():
            value = stats.exploring.get(name, math.nan)
            # NaN is not below, either.
            if not value <= most:
                bound = f"{name.replace('_', ' ')} {most:g} {cfg.units.get(name, '')}".rstrip()
                return f"from exploring {bound} on ({value:.2f} now)"
        start = f"from exploring return {cfg.trigger:,.0f} on"
        if stats.exploring_length in (None, steps):
            return start
        # Episodes that fail are shorter.
        now = stats.mean_step_reward * steps
        return f"{start}, at full length ({now:,.0f} now)"

    # Text.

    def line(self) -> str:
        """Return one line for log files."""
        stats = self.stats
        if stats is None:
            return f"[{self.iteration}/{self._total}] 0:00"
        name = "step_reward" if stats.exploring_return is None else "return"
        parts = [f"[{stats.iteration}/{self._total}]", clock(self.spent)]
        values = [(name, f"{number(self._exploring(stats))}(exploring)")]
        for bound in self._bounds:
            evaluated = _texts(bound, self._evaluations[-1][1]) if self._evaluations else None
            if bound.name == "mean_return":
                if evaluated:
                    values.append(("evaluated_return", evaluated[0]))
                values.append(("goal", limit(bound)))
            elif evaluated:
                observed, judged = evaluated
                note = (
                    required(bound) if judged == observed else f"judged {judged} {required(bound)}"
                )
                values.append((bound.name, f"{observed.removesuffix(f' {bound.unit}')}({note})"))
        if self._evaluations:
            iteration, result = self._evaluations[-1]
            values.append(("evaluated_at", str(iteration)))
            if state := curricula_text(result.curricula):
                values.append(("evaluated_under", state))
        values.append(("steps/s", f"{stats.steps_per_second:.0f}"))
        if (usual := self.usual_end) is not None:
            when = "" if usual[1] is None else f"(in {clock(usual[1])})"
            values.append(("usually_solved_near", f"{usual[0]}{when}"))
        elif self.left_at_most:
            values.append(("left_at_most", clock(self.left_at_most)))
        # Words without spaces, for programs that read the line.
        drop = str.maketrans(" ", "_", ",")
        parts += [f"{name}={value.replace(' %', '%').translate(drop)}" for name, value in values]
        return " ".join(parts)

    def ending(self) -> str:
        """Return how training ended: solved, or the bounds missed and by how much."""
        if self.ended == "failed" and self.stats is None:
            return "Failed before the first iteration."
        at = f"iteration {self.iteration}"
        if self.ended != "solved":
            at += f" of {self._total}"
        head = _ENDS.get(self.ended or "", "Failed")
        verdict = self._verdict()
        if verdict and head == "Finished":
            return f"{head}: {verdict} at {at}, {duration(self.spent)}. {self._scores()}".rstrip()
        return f"{head} at {at}, {duration(self.spent)}. {self._scores()}".rstrip()

    def _verdict(self) -> str:
        if self.ended == "solved" or not self._bounds:
            return self.ended if self.ended == "solved" else ""
        met = self._evaluations and all(b.is_met(self._evaluations[-1][1]) for b in self._bounds)
        return "all bounds met" if met else "unsolved"

    def _scores(self) -> str:
        """Return the last evaluation beside its bounds; the exploring return without evaluations."""
        if not self._evaluations or not self._bounds:
            exploring = ""
            if self.stats is not None:
                exploring = f"Return {number(self._exploring(self.stats))}, exploring"
            if not self._bounds:
                return exploring and f"{exploring}."
            goals = [f"{label(bound.name)} {required(bound)}" for bound in self._bounds]
            upcoming = self._next_evaluation()
            when = f" (evaluations start {upcoming})" if upcoming else ""
            return f"{exploring}; not evaluated{when}. Goal: {', '.join(goals)}."
        iteration, result = self._evaluations[-1]
        parts = []
        for bound in self._bounds:
            text = f"{label(bound.name)} {shown(bound, result)} of {limit(bound)}"
            if bound.name != "mean_return":
                text = f"{label(bound.name)} {shown(bound, result)} ({required(bound)})"
            if not bound.is_met(result):
                missed = abs(result.judged(bound.name) - bound.limit)
                text += f", missed by {formatted(bound, missed).replace('%', 'points')}"
            parts.append(text)
        scores = "; ".join(parts)
        when = "" if iteration == self.iteration else f" at iteration {iteration}"
        state = curricula_text(result.curricula)
        when += f", under {state}" if state else ""
        return f"{scores[:1].upper()}{scores[1:]}; {counted(result.num_episodes, 'episode')}{when}."

    def rows(self) -> list[tuple[str, str]]:
        """Return the values of the panel as (name, text)."""
        rows = [("time", self._time_left())]
        stats = self.stats
        if stats is None:
            return rows
        solves = "" if self.solved_return is None else f"; {number(self.solved_return)} solves"
        unit = _UNITS[stats.exploring_return is None]
        rows.append((unit, f"{number(self._exploring(stats))}, exploring{solves}"))
        rows.append(("episodes", self._episodes(stats)))
        if self._bounds:
            last = self._scores() if self._evaluations else "none yet"
            rows += [("last eval", last), ("next eval", self._next_evaluation() or "")]
        share = stats.learning_time / max(stats.collection_time + stats.learning_time, 1e-9)
        speed = f"{stats.steps_per_second:,.0f} steps/s (learning takes {share:.0%})"
        return [*rows, ("speed", speed)]

    # Panel.

    def __rich_console__(
        self, console: Console, options: ConsoleOptions
    ) -> Iterator[RenderableType]:
        """Render the panel: progress, the judged values beside their bounds, and speed."""
        head = Table.grid(expand=True)
        head.add_column()
        head.add_column(justify="right")
        head.add_row(Text(self._cfg.title, style="bold"), clock(self.spent))
        yield head
        if self.ended is not None:
            yield Text(self.ending())
            return
        rows = Table.grid(padding=(0, 2))
        rows.add_column(style="dim", no_wrap=True)
        rows.add_column()
        bar = Table.grid(padding=(0, 1))
        done = ProgressBar(total=max(self._total, 1), completed=self.iteration, width=24)
        bar.add_row(str(self.iteration), done, str(self._total))
        rows.add_row(" iteration", bar)
        for name, text in self.rows():
            if name == "last eval" and self._evaluations:
                rows.add_row(f" {name}", self._judged())
            else:
                rows.add_row("" if name == "time" else f" {name}", text)
            if name in _UNITS and len(self._returns) > 1:
                bars = _ASCII_BARS if options.ascii_only else _BARS
                rows.add_row("", sparkline(self._returns, bars))
        rows.add_row("", Text("Ctrl-C saves, then stops.", style="dim"))
        yield rows

    def _time_left(self) -> str:
        left, usual = self.left_at_most, self.usual_end
        text = "starting ..." if left is None else f"at most {duration(left)} left"
        if usual is None:
            return text
        iteration, until = usual
        when = "" if until is None else f", in {duration(until)}"
        return f"usually solved near iteration {iteration}{when}; {text}"

    def _episodes(self, stats: IterationStats) -> str:
        noise = f"action noise {stats.action_std:.2f}"
        length, step = stats.exploring_length, self._cfg.step_seconds
        if length is None or self._cfg.episode_steps is None or step is None:
            return noise
        of_seconds = f"{length * step:.1f} of {self._cfg.episode_steps * step:.1f} s"
        return f"{of_seconds}, {noise}"

    def _judged(self) -> RenderableType:
        iteration, result = self._evaluations[-1]
        when = f"iteration {iteration}, {counted(result.num_episodes, 'episode')}"
        if state := curricula_text(result.curricula):
            when += f", under {state}"
        table = Table.grid(padding=(0, 2))
        for _ in range(4):
            table.add_column()
        for bound in self._bounds:
            state = self._state(bound)
            table.add_row(
                label(bound.name),
                shown(bound, result),
                Text(state, style="green" if state == "met" else ""),
                required(bound),
            )
        return Group(table, Text(when, style="dim"))


class NotebookProgress(TrainingProgress):
    """Progress in one output of a notebook, replaced while training runs."""

    def __init__(self, cfg: ProgressCfg) -> None:
        super().__init__(cfg)
        self._output: Any = None
        self._last_output = float("-inf")

    def on_start(self, first_iteration: int, total_iterations: int) -> None:
        """Open the output."""
        super().on_start(first_iteration, total_iterations)
        # Installed wherever notebooks run.
        from IPython.display import display

        self._last_output = time.perf_counter()
        self._output = display(self._content(), raw=True, display_id=True)

    def on_iteration(self, stats: IterationStats) -> None:
        """Update the output, at most twice per second."""
        super().on_iteration(stats)
        if time.perf_counter() - self._last_output >= _SECONDS_BETWEEN_OUTPUTS:
            self._update()

    def on_end(self, reason: str) -> None:
        """Replace the panel by the result."""
        super().on_end(reason)
        self._update()

    def _update(self) -> None:
        if self._output is not None:
            self._output.update(self._content(), raw=True)
        self._last_output = time.perf_counter()

    def _content(self) -> dict[str, str]:
        text = io.StringIO()
        Console(
            file=text,
            width=_NOTEBOOK_WIDTH,
            force_terminal=False,
            force_jupyter=False,
            color_system=None,
        ).print(self)
        plain = text.getvalue().rstrip()
        style = "line-height:1.25;white-space:pre-wrap"
        return {
            "text/plain": plain,
            "text/html": f'<pre style="{style}">{escaped(plain)}</pre>',
        }


def in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook (Jupyter, Colab, VS Code)."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return getattr(shell, "kernel", None) is not None


# Formats.


def label(name: str) -> str:
    """Return the name of an evaluation's value in words."""
    return "return" if name == "mean_return" else name.replace("_", " ")


def title(bound: Bound) -> str:
    """Return the name of the value of `bound` with its unit, as charts show it."""
    name, unit = label(bound.name).capitalize(), "%" if bound.is_rate else bound.unit
    return f"{name} ({unit})" if unit else name


def formatted(bound: Bound, value: float) -> str:
    """Format a value of evaluations with the unit of `bound`; rates in percent."""
    if bound.is_rate:
        return f"{100.0 * value:.3g} %"
    return f"{number(value)} {bound.unit}".rstrip()


def shown(bound: Bound, result: EvaluationResult) -> str:
    """Format a value of evaluations, in full if rounding would hide that `bound` is missed.

    For rates, the observed one, then the one that is judged: `7.5 % (judged: 11.2 %)`.
    """
    observed, judged = _texts(bound, result)
    return observed if judged == observed else f"{observed} (judged: {judged})"


def _texts(bound: Bound, result: EvaluationResult) -> tuple[str, str]:
    """Format the observed and the judged value."""
    value = result.judged(bound.name)
    judged = formatted(bound, value)
    is_rate = bound.is_rate
    if judged == limit(bound) and not bound.is_met(result):
        judged = f"{100.0 * value:.6g} %" if is_rate else f"{value:.7g} {bound.unit}".rstrip()
    return formatted(bound, result.value(bound.name)) if is_rate else judged, judged


def limit(bound: Bound) -> str:
    """Format the limit of `bound`."""
    return formatted(bound, bound.limit)


def required(bound: Bound) -> str:
    """Format `bound`: `at most 5 %`."""
    return f"at {'most' if bound.is_upper else 'least'} {limit(bound)}"


def sparkline(values: list[float], bars: str = _BARS) -> str:
    """Return a curve in characters: means of up to 24 parts of `values`, from lowest to highest."""
    values = [value for value in values if math.isfinite(value)]
    if not values:
        return ""
    parts = min(len(values), _READINGS)
    edges = [len(values) * i // parts for i in range(parts + 1)]
    means = [sum(values[a:b]) / (b - a) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    low, high = min(means), max(means)
    if high == low:
        return bars[0] * parts
    return "".join(bars[int((mean - low) / (high - low) * (len(bars) - 1))] for mean in means)
