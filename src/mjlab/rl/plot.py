"""Plots of learning curves from the event files of runs."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mjlab.rl.config import EvaluationCfg
from mjlab.utils.errors import check_one_of
from mjlab.utils.os import files_in, naming
from mjlab.utils.string import counted, suggest

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from mjlab.rl.evaluation import Bound

logger = logging.getLogger(__name__)

DEFAULT_TAG = "Train/exploring_return"
"""Tag of plots: the return, in the unit of evaluations."""
LABELS = {
    DEFAULT_TAG: "Return per episode\n(sum of weighted rewards)",
    "Train/mean_step_reward": "Weighted reward per step",
    "Train/mean_reward": "Rewards of an episode, scaled by the time step",
    "Train/mean_episode_length": "Mean episode length (steps)",
    "Evaluation/mean_return": "Return per episode in evaluations\n(sum of weighted rewards)",
    "Evaluation/mean_length": "Episode length in evaluations (steps)",
    "Evaluation/failure_rate": "Failure rate in evaluations (fraction)",
    "Evaluation/success_rate": "Success rate in evaluations (fraction)",
}
"""Labels of axes, by tag."""

# Written in every iteration, so the first value is the first iteration of a session.
_EVERY_ITERATION = "Perf/collection_time"
# Widths in characters, of a legend and of a handle in it.
_LEGEND_WIDTH, _LEGEND_HANDLE = 90, 6
# Goals so many times as high as the curve are not drawn.
_FAR = 1000.0
# Small axes side by side.
_IN_A_ROW = 3
# Instead of the default: endless episodes have no return, and runs of other packages lack both.
_FALLBACKS = ("Train/mean_step_reward", "Train/mean_reward")

Curve = tuple[np.ndarray, np.ndarray]
"""Iterations, from 0, and values, each (P,)."""
Run = str | Path | Sequence[str | Path]
"""Folder of a run, or of each part of a resumed run, the first part first."""


def read_scalars(run: Run, tag: str) -> Curve:
    """Return iterations and values of `tag` from the event files of a run, see `read_all_scalars`.

    Raises:
        ValueError: no event files, or the tag is unknown; the message lists the tags.
    """
    return _curve(run, read_all_scalars(run), tag)


def read_all_scalars(run: Run) -> dict[str, Curve]:
    """Return iterations and values by tag from the event files of a run.

    Parts of a resumed run are joined: from its first iteration on, the later part counts. For tags that
    end with `/time`, iterations are seconds. A file that is damaged, or whose writer was killed, is read
    up to that point, with a warning.

    Raises:
        ValueError: no event files.
    """
    folders = _folders(run)
    paths = [path for part in folders for path in sorted(files_in(part, "events.out.tfevents.*"))]
    if not paths:
        raise ValueError(
            f"run: no TensorBoard event files in '{folders[-1]}'; use the folder of a run, such as "
            "logs/rsl_rl/<experiment>/<time>."
        )
    values: dict[str, dict[int, float]] = {}
    for path in paths:
        new: dict[str, dict[int, float]] = {}
        for tag, step, value in _scalar_events(path):
            curve = new.setdefault(tag, {})
            _drop_from(step, curve)
            curve[step] = value
        if _EVERY_ITERATION in new:
            first = next(iter(new[_EVERY_ITERATION]))
            for tag, curve in values.items():
                if not tag.endswith("/time"):
                    _drop_from(first, curve)
        for tag, curve in new.items():
            # Sessions solved at their start have evaluations only.
            _drop_from(next(iter(curve)), values.setdefault(tag, {}))
            values[tag] |= curve
    return {
        tag: (np.array([*curve]), np.array([*curve.values()], dtype=float))
        for tag, curve in values.items()
        if curve
    }


def _folders(run: Run) -> list[Path]:
    return [Path(run)] if isinstance(run, (str, Path)) else [Path(part) for part in run]


def _drop_from(step: int, curve: dict[int, float]) -> None:
    """Drop the values from `step` on: a resumed run continues from its checkpoint."""
    while curve and next(reversed(curve)) >= step:
        curve.popitem()


def _curve(run: Run, curves: Mapping[str, Curve], tag: str) -> Curve:
    if tag not in curves:
        folder = str(_folders(run)[-1])
        raise ValueError(f"Run {folder!r}: unknown tag {tag!r}; {suggest(tag, curves)}")
    return curves[tag]


def default_tag(runs: Sequence[Mapping[str, Curve]]) -> str:
    """Return the tag to plot: the return, or what else all `runs` have."""
    for tag in (DEFAULT_TAG, *_FALLBACKS):
        if all(tag in curves for curves in runs):
            return tag
    return DEFAULT_TAG


def solved_at(curves: Mapping[str, Curve], evaluation: EvaluationCfg) -> int | None:
    """Return the number of iterations until a task was solved, None if it was not.

    Args:
        curves: Result of `read_all_scalars`.
        evaluation: Conditions of the run. If its training stops when solved, the confirmation counts.
    """
    from mjlab.rl.evaluation import Bound, wilson_interval

    bounds = Bound.all_of(evaluation)
    group = "Confirmation" if evaluation.stop_when_solved else "Evaluation"
    met: dict[int, int] = {}
    for bound in bounds:
        for iteration, value in zip(*curves.get(f"{group}/{bound.name}", ((), ())), strict=True):
            if bound.is_rate:
                value = sum(wilson_interval(value, evaluation.num_episodes)) / 2
            is_met = value <= bound.limit if bound.is_upper else value >= bound.limit
            met[iteration] = met.get(iteration, 0) + int(is_met)
    solved = [iteration for iteration, count in met.items() if count == len(bounds)]
    return int(min(solved)) + 1 if solved else None


def _scalar_events(path: Path) -> Generator[tuple[str, int, float]]:
    """Yield tag, step and value of the scalars in an event file."""
    from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader
    from tensorboard.compat.proto import event_pb2

    # Generated by protobuf, without type annotations.
    parse: Callable[[bytes], Any] = vars(event_pb2)["Event"].FromString
    size, read = path.stat().st_size, 0
    for record in RawEventFileLoader(str(path)).Load():
        # Length, contents and their checksums.
        read += len(record) + 16
        event = parse(record)
        for value in event.summary.value:
            if value.HasField("simple_value"):
                yield value.tag, event.step, value.simple_value
    if read < size:
        logger.warning(
            "The last %d of %d bytes of %s cannot be read: the file is damaged, or its writer was killed.",
            size - read, size, path,
        )  # fmt: skip


def plot_run(
    run: Run,
    output: str | Path | None = None,
    *,
    tag: str | None = None,
    title: str | None = None,
    evaluation: EvaluationCfg | Mapping[str, Any] | None = None,
) -> Path:
    """Plot the learning curve of one run.

    Args:
        run: Folder of the run, or of each part of a resumed run.
        output: PNG file; None: `learning_curve.png` in the (last) folder.
        tag: Tag to plot, as in the event files. None: the return of the exploring policy and of
            evaluations.
        title: Title of the figure; None: the folder's name.
        evaluation: `EvaluationCfg` of the run, or its fields by name: without `tag`, the bounds of a
            solved task are drawn, each besides that of the return on its own axes.

    Returns:
        Path of the PNG file.

    Raises:
        ValueError: see `read_scalars`.
    """
    from mjlab.rl.evaluation import Bound

    folder, curves = _folders(run)[-1], read_all_scalars(run)
    shown = default_tag([curves]) if tag is None else tag
    iterations, values = _curve(run, curves, shown)
    bounds = Bound.all_of(EvaluationCfg.of(evaluation)) if tag is None else []
    others = [b for b in bounds if b.name != "mean_return" and f"Evaluation/{b.name}" in curves]
    figure, top, below = _new_figure(len(others))
    top.plot(iterations + 1, values, color="tab:blue", label="exploring policy")
    top.set(xlabel="Iteration", ylabel=LABELS.get(shown, shown))
    if tag is None and shown == DEFAULT_TAG:
        goals = [bound for bound in bounds if bound.name == "mean_return"]
        _draw_evaluations(top, curves, "mean_return", goals[0] if goals else None)
    for axes, bound in zip(below, others, strict=True):
        if (curve := curves.get(f"Train/{bound.name}")) is not None:
            axes.plot(curve[0] + 1, curve[1], color="tab:blue", lw=1, label="exploring policy")
        _draw_evaluations(axes, curves, bound.name, bound)
        _finish_small(axes, bound, top)
    _add_environment_steps(top, curves)
    title = folder.resolve().name if title is None else title
    return _save(figure, folder / "learning_curve.png" if output is None else output, title)


def _draw_evaluations(
    axes: Axes, curves: Mapping[str, Curve], name: str, goal: Bound | None
) -> None:
    """Draw a value of evaluations and confirmations, and its goal."""
    scale = 1.0 if goal is None else goal.scale
    marks: dict[str, dict[str, Any]] = {
        "Evaluation": {"ls": ":", "lw": 1, "marker": "o", "ms": 4, "color": "tab:orange"},
        # Around the evaluation that it confirms.
        "Confirmation": {
            "ls": "",
            "marker": "*",
            "ms": 15,
            "mfc": "none",
            "color": "tab:green",
            "clip_on": False,
        },
    }
    for group, style in marks.items():
        if (curve := curves.get(f"{group}/{name}")) is not None:
            axes.plot(curve[0] + 1, scale * curve[1], label=group.lower(), **style)
    if goal is not None:
        _draw_goal(axes, scale * goal.limit)


def _finish_small(axes: Axes, bound: Bound, top: Axes) -> None:
    """Name the value on small axes, which share the iterations of `top`."""
    from mjlab.rl.progress import title

    axes.set_xlim(top.get_xlim())
    axes.set_title(title(bound), fontsize="small")
    axes.tick_params(labelsize="small")
    if axes.dataLim.y0 >= 0.0:
        axes.set_ylim(bottom=0.0)


def _draw_goal(axes: Axes, goal: float) -> None:
    # A goal that nothing reaches, to train to the end, would flatten the curve.
    if abs(goal) <= _FAR * max(1.0, abs(axes.dataLim.y0), abs(axes.dataLim.y1)):
        axes.axhline(goal, ls="--", lw=1, color="dimgray", zorder=1, label="goal")


def _add_environment_steps(axes: Axes, curves: Mapping[str, Curve]) -> None:
    """Add an axis of environment steps at the top, if all iterations have about as many."""
    parts = ("Perf/total_fps", "Perf/collection_time", "Perf/learning_time")
    if any(part not in curves for part in parts):
        return
    speed, collecting, learning = (curves[part][1] for part in parts)
    if not len(speed) == len(collecting) == len(learning):
        return
    steps = speed * (collecting + learning)
    if 0.0 < 0.99 * steps.max() < steps.min():
        from matplotlib.ticker import EngFormatter

        # The logged speed is rounded down.
        each = float(steps.max())
        above = axes.secondary_xaxis(
            "top", functions=(lambda x: np.multiply(x, each), lambda x: np.divide(x, each))
        )
        above.set_xlabel("Environment steps", fontsize="small")
        above.tick_params(labelsize="small")
        above.xaxis.set_major_formatter(EngFormatter(sep=""))


def plot_seeds(
    runs: Sequence[Run] | Mapping[str, Sequence[Run]],
    output: str | Path,
    *,
    tag: str | None = None,
    title: str | None = None,
    goal: float | None = None,
    evaluation: EvaluationCfg | Mapping[str, Any] | None = None,
) -> Path:
    """Plot the mean over runs with different seeds, with one sample standard deviation shaded.

    Where not all runs of a group have data, because some ended or were interrupted, single runs are
    drawn instead.

    Args:
        runs: Runs of distinct seeds; or several lists of runs by name, one curve each.
        output: PNG file.
        tag: Tag to plot, as in the event files. None: the return of the exploring policy.
        title: Title of the figure; None: the number of seeds.
        goal: Value to mark by a line.
        evaluation: `EvaluationCfg` of the runs, or its fields by name: without `tag`, what solves the
            task besides the return is drawn on its own axes for each run: evaluations as points, values
            while exploring as lines.

    Returns:
        Path of the PNG file.

    Raises:
        ValueError: `runs` is empty, or see `read_scalars`.
    """
    groups = runs if isinstance(runs, Mapping) else {"": runs}
    if not groups or not all(groups.values()):
        raise ValueError(f"runs: expected at least one run folder, got {runs}.")
    from mjlab.rl.evaluation import Bound

    read = {name: [(run, read_all_scalars(run)) for run in of] for name, of in groups.items()}
    bounds = Bound.all_of(EvaluationCfg.of(evaluation)) if tag is None else []
    every = [curves for of in read.values() for _, curves in of]
    others = [
        bound
        for bound in bounds
        if bound.name != "mean_return" and any(f"Evaluation/{bound.name}" in c for c in every)
    ]
    tag = tag or default_tag(every)
    drawn: dict[str, list[Curve]] = {}
    for name, of in read.items():
        found = [_curve(run, curves, tag) for run, curves in of]
        count = counted(len(found), "seed")
        drawn[f"{name} ({count})" if name else ""] = [(i + 1, values) for i, values in found]
    if title is None:
        count = counted(max(map(len, drawn.values())), "seed")
        over = "seeds" if any(groups) else count
        title = f"Mean and standard deviation over {over}"
    figure, top, below = _new_figure(len(others))
    colors = _draw_groups(top, drawn)
    if goal is not None:
        _draw_goal(top, goal)
    top.set(xlabel="Iteration", ylabel=LABELS.get(tag, tag))
    for axes, bound in zip(below, others, strict=True):
        for color, of in zip(colors, read.values(), strict=True):
            for _, curves in of:
                for group, style in (("Train", "-"), ("Evaluation", "o")):
                    if (curve := curves.get(f"{group}/{bound.name}")) is not None:
                        shown = bound.scale * curve[1]
                        axes.plot(curve[0] + 1, shown, style, lw=0.8, ms=4, c=color)
        _draw_goal(axes, bound.scale * bound.limit)
        _finish_small(axes, bound, top)
    return _save(figure, output, title)


def plot_curves(
    groups: Mapping[str, Sequence[Curve]],
    output: str | Path,
    *,
    title: str,
    xlabel: str = "Iteration",
    ylabel: str,
    draw: Callable[[Axes], Any] | None = None,
) -> Path:
    """Plot the mean over the curves of each group, with one sample standard deviation shaded.

    The mean is drawn where all curves of a group have data; elsewhere, single curves are thin.

    Args:
        groups: Curves by group name; groups with an empty name are not in the legend.
        output: PNG file.
        title: Title of the figure.
        xlabel: Label of the x axis.
        ylabel: Label of the y axis.
        draw: Function that draws more on the axes, after the groups.

    Returns:
        Path of the PNG file.
    """
    figure, axes, _ = _new_figure()
    _draw_groups(axes, groups)
    if draw is not None:
        draw(axes)
    axes.set(xlabel=xlabel, ylabel=ylabel)
    return _save(figure, output, title)


def _draw_groups(axes: Axes, groups: Mapping[str, Sequence[Curve]]) -> list[Any]:
    """Draw mean and standard deviation of each group; return their colors."""
    colors = []
    for name, curves in groups.items():
        x, mean, std = mean_and_std(curves)
        # A line through one point is invisible.
        (line,) = axes.plot(x, mean, marker="o" if len(x) == 1 else None, label=name or None)
        color = line.get_color()
        colors.append(color)
        axes.fill_between(x, mean - std, mean + std, alpha=0.25, color=color, lw=0)
        for one in curves:
            # Up to the first and from the last point of the mean, which it may only touch.
            begin, end, touching = (x[0], x[-1], 1) if len(x) else (np.inf, np.inf, 0)
            for part in (one[0] <= begin, one[0] >= end):
                if part.sum() > touching:
                    style: dict[str, Any] = {
                        "lw": 0.8,
                        "alpha": 0.6,
                        "color": color,
                        "marker": "o" if part.sum() == 1 else None,
                        "label": "single seeds",
                    }
                    axes.plot(one[0][part], one[1][part], **style)
    return colors


def _new_figure(below: int = 0) -> tuple[Figure, Axes, list[Axes]]:
    """Return a figure, its axes, and small axes below them."""
    # pyplot would choose a window system and keep the figure.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = 1 + math.ceil(below / _IN_A_ROW)
    heights = [3.2] + [1.5] * (rows - 1)
    figure = Figure(figsize=(7.0, 0.8 + sum(heights)), layout="constrained")
    FigureCanvasAgg(figure)
    columns = max(1, min(below, _IN_A_ROW))
    grid = figure.add_gridspec(rows, columns, height_ratios=heights)
    cells = [grid[1 + i // columns, i % columns] for i in range(below)]
    return figure, figure.add_subplot(grid[0, :]), [figure.add_subplot(cell) for cell in cells]


def picture_path(output: str | Path, owner: str = "output") -> Path:
    """Return the path of a picture: `output`, with the ending `.png` if it has none.

    Raises:
        ValueError: a folder, or an ending of no format of pictures. `owner` is the argument to name.
    """
    from matplotlib.backend_bases import FigureCanvasBase

    path = Path(output)
    if path.is_dir():
        raise ValueError(
            f"{owner}: expected a PNG file, got the folder '{path}'; use a path in it."
        )
    if not path.suffix:
        return path.with_name(f"{path.name}.png")
    formats = FigureCanvasBase.get_supported_filetypes()
    check_one_of(f"{owner} {path}: ending", path.suffix[1:].lower(), formats)
    return path


def _save(figure: Figure, output: str | Path, title: str) -> Path:
    """Finish and write a figure."""
    for axes in figure.axes:
        lines = [np.asarray(line.get_ydata(), float) for line in axes.lines]
        values = np.concatenate(lines or [np.zeros(0)])
        if (limits := visible_range(values)) is not None:
            axes.set_ylim(limits)
            beyond = int(((values < limits[0]) | (values > limits[1])).sum())
            axes.set_title(f"{beyond} beyond the axis", loc="right", fontsize="small")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    # By text: several lines may have the same.
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(text, handle)
    texts = [figure.suptitle(title), *(axes.yaxis.label for axes in figure.axes)]
    if handles:
        legend = figure.legend(
            handles.values(), handles.keys(), loc="outside lower center", frameon=False,
            ncols=max(1, min(4, _LEGEND_WIDTH // (_LEGEND_HANDLE + max(map(len, handles))))),
        )  # fmt: skip
        texts += legend.get_texts()
    for text in texts:
        # Names may have a "$".
        text.set_parse_math(False)
    output = picture_path(output)
    output.parent.mkdir(parents=True, exist_ok=True)
    with naming(output):
        figure.savefig(output, dpi=150)
    return output


def mean_and_std(curves: Sequence[Curve]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return iterations, mean and sample standard deviation over `curves`, where all have data.

    The iterations are those of any curve between the last begin and the first end, none if there is no
    such range. The standard deviation divides by n - 1; for one curve it is 0. Curves are linear between
    their points.
    """
    iterations = np.unique(np.concatenate([curve[0] for curve in curves]))
    first, last = max(curve[0][0] for curve in curves), min(curve[0][-1] for curve in curves)
    iterations = iterations[(iterations >= first) & (iterations <= last)]
    values = np.stack([np.interp(iterations, *curve) for curve in curves])
    std = values.std(axis=0, ddof=1) if len(values) > 1 else np.zeros(len(iterations))
    return iterations, values.mean(axis=0), std


def visible_range(values: np.ndarray) -> tuple[float, float] | None:
    """Return the axis range without outliers, None without outliers.

    The range is that of the values without the highest and the lowest hundredth, at least one of each,
    if the range of all values is more than 20 times as wide. Values that are not finite do not count.
    None for fewer than 50 values.
    """
    values = np.sort(values[np.isfinite(values)])
    cut = max(1, len(values) // 100)
    if len(values) < 50:
        return None
    low, high = float(values[cut]), float(values[-cut - 1])
    if not 0 < 20 * (high - low) < values[-1] - values[0]:
        return None
    margin = 0.05 * (high - low)
    return low - margin, high + margin
