"""Page of a policy to share: recorded episodes in 3-D beside what its run and its evaluation say."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

from mjlab.rl.config import EvaluationCfg
from mjlab.runs.evaluation import evaluation_rows
from mjlab.runs.run import Run
from mjlab.utils.page import CHART_STYLE, COLORS, Line, chart, facts, listed, sparkline
from mjlab.utils.string import encodable, escaped, number

if TYPE_CHECKING:
    from mjlab.rl.plot import Curve
    from mjlab.viewer.viser.recording import Episode, Recording

_TEMPLATE = Path(__file__).with_suffix(".html")


@dataclass(frozen=True, kw_only=True)
class SharedPage:
    """Content of a page."""

    task: str
    """Task."""
    origin: Mapping[str, Any]
    """Facts of the policy and of the recording, by name; those of None are not recorded."""
    recording: Recording
    """Recorded episodes."""
    reward_unit: float
    """Factor from weighted rewards to those of the episodes."""
    command_names: Mapping[str, Sequence[str]]
    """Names of the components, with units, of the commands to draw."""
    curves: Sequence[str] = ()
    """Charts of the learning curve; empty if training is not recorded."""
    evaluation: Mapping[str, Any] | None = None
    """Result of `evaluate`; None if not measured."""
    evaluation_command: str = ""
    """Command that measures it."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the run that differ from the registered task."""

    def html(self) -> str:
        """Return the page."""
        recording = self.recording
        legend = " ".join(
            f'<b style="color:{_css_color(color)}">●</b> {escaped(meaning)}'
            for meaning, color in recording.legend.items()
        )
        sections = {
            "Recorded episodes": self._episodes(),
            "Commands": "".join(self._commands()),
            "Rewards": self._rewards(),
            "Evaluation": self._evaluation(),
            "Learning curve": "".join(self.curves)
            or "<p>Not recorded: the policy comes without its training.</p>",
            "Policy": self._policy(),
        }
        page = Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
            title=escaped(self.task),
            subtitle=escaped(self._subtitle()),
            chart_style=CHART_STYLE,
            # As short as an attribute may be: the page of the scene has many `<`.
            scene=recording.html.replace("&", "&amp;").replace('"', "&quot;"),
            legend=legend,
            sections="\n".join(
                f"<section><h2>{name}</h2>{content}</section>"
                for name, content in sections.items()
                if content
            ),
        )
        return encodable(page)

    def _subtitle(self) -> str:
        shown = ("profile", "learner", "policy")
        return ", ".join(f"{name} {self.origin[name]}" for name in shown if self.origin.get(name))

    def _episodes(self) -> str:
        head = "<tr><th>from</th><th>duration</th><th>return</th><th>end</th></tr>"
        rows = [
            [
                f"{one.start:.1f} s",
                f"{one.seconds:.1f} s",
                number(one.total_reward / self.reward_unit),
                _end_of(one),
            ]
            for one in self.recording.episodes
        ]
        return f'<div class="wide"><table>{head}{_rows(rows)}</table></div>'

    def _commands(self) -> Iterable[str]:
        times, starts = self.recording.times, self._starts()
        for name, components in self.command_names.items():
            values = zip(*self.recording.commands[name], strict=True)
            lines = [
                Line(component, times, list(of))
                for component, of in zip(components, values, strict=True)
            ]
            yield chart(name, lines, x_label="time (s)", rules=starts, has_cursor=True)

    def _rewards(self) -> str:
        times, terms = self.recording.times, self.recording.rewards
        if not terms:
            return ""
        total = [sum(values) for values in zip(*terms.values(), strict=True)]
        drawn = chart(
            "Sum of weighted rewards per step",
            [Line("", times, total)],
            x_label="time (s)",
            rules=self._starts(),
            has_cursor=True,
        )
        rows = []
        for name, values in terms.items():
            finite = [value for value in values if math.isfinite(value)]
            mean = sum(finite) / max(len(finite), 1)
            drawing = sparkline(times, values, COLORS[2] if mean >= 0.0 else COLORS[1])
            rows.append(f"<tr><td>{escaped(name)}</td><td>{mean:.3g}</td><td>{drawing}</td></tr>")
        head = "<tr><th>term</th><th>mean</th><th>over time</th></tr>"
        return f'{drawn}<div class="wide"><table>{head}{"".join(rows)}</table></div>'

    def _starts(self) -> list[float]:
        return [episode.start for episode in self.recording.episodes[1:]]

    def _evaluation(self) -> str:
        found = self.evaluation
        if found is None:
            return (
                "<p>Not measured. This command measures the policy; a page made after it has the "
                f"values.</p><pre>{escaped(self.evaluation_command)}</pre>"
            )
        head = "<tr><th></th><th>mean</th><th>95 % interval</th></tr>"
        about = (
            f"{found['num_episodes']:,} episodes, seed {found.get('seed')}; {found.get('physics')}."
        )
        if found.get("success_definition") is not None:
            about += f" Success: {found['success_definition']}."
        return (
            f'<div class="wide"><table>{head}{_rows(evaluation_rows(found))}</table></div>'
            f"<p>{escaped(about)}</p>{listed(found.get('notes') or ())}"
        )

    def _policy(self) -> str:
        known = {name: value for name, value in self.origin.items() if value is not None}
        missing = [name for name, value in self.origin.items() if value is None]
        text = facts({"task": self.task, **known})
        if missing:
            text += f"<p>Not recorded: {escaped(', '.join(missing))}.</p>"
        if self.settings:
            text += "<p>Settings that differ from the registered task:</p>" + listed(
                f"{path}: {value}" for path, value in self.settings.items()
            )
        return text


def learning_curves(run: Run, evaluation: EvaluationCfg) -> list[str]:
    """Return charts of the return and of other values that solve the task, over iterations."""
    from mjlab.rl.evaluation import Bound
    from mjlab.rl.plot import DEFAULT_TAG, LABELS, default_tag, read_all_scalars
    from mjlab.rl.progress import title
    from mjlab.runs.reference import parts_of

    try:
        curves = read_all_scalars(parts_of(run.folder))
    except ValueError:
        return []
    if (tag := default_tag([curves])) not in curves:
        return []
    bounds = {bound.name: bound for bound in Bound.all_of(evaluation)}
    lines = [_line("exploring policy", curves[tag])]
    goal = None
    if tag == DEFAULT_TAG:
        lines += _evaluated(curves, "mean_return")
        goal = bounds.pop("mean_return", None)
    span = (lines[0].x[0], lines[0].x[-1])
    charts = [_with_goal(LABELS.get(tag, tag), lines, goal, span)]
    for name, bound in bounds.items():
        if drawn := _evaluated(curves, name, bound.scale):
            charts.append(_with_goal(title(bound), drawn, bound, span))
    return charts


def _evaluated(curves: Mapping[str, Curve], name: str, scale: float = 1.0) -> list[Line]:
    found = curves.get(f"Evaluation/{name}")
    return [] if found is None else [_line("evaluations", found, scale, has_marks=True)]


def _line(name: str, curve: Curve, scale: float = 1.0, *, has_marks: bool = False) -> Line:
    return Line(name, list(curve[0] + 1), list(scale * curve[1]), has_marks=has_marks)


def _with_goal(title: str, lines: list[Line], goal: Any, span: tuple[float, float]) -> str:
    """Return the chart of lines over the iterations in `span`, with the bound that solves the task."""
    if goal is not None:
        limit = goal.scale * goal.limit
        lines = [*lines, Line("goal", span, [limit, limit], is_dashed=True)]
    return chart(title, lines, x_label="iteration")


def _rows(rows: Iterable[Iterable[str]]) -> str:
    return "".join(
        f"<tr>{''.join(f'<td>{escaped(cell)}</td>' for cell in row)}</tr>" for row in rows
    )


def _end_of(episode: Episode) -> str:
    return ", ".join(episode.ended_by) or "end of the recording"


def _css_color(color: Sequence[float]) -> str:
    return f"rgb({','.join(f'{255 * part:.0f}' for part in color[:3])})"
