"""Learning curves, drawn from the event files of runs."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mjlab.utils.string import suggest

if TYPE_CHECKING:
    from matplotlib.axes import Axes

logger = logging.getLogger(__name__)

DEFAULT_TAG = "Train/mean_step_reward"
_LABELS = {
    DEFAULT_TAG: "Mean reward per step",
    "Train/mean_reward": "Mean reward of an episode",
    "Train/mean_episode_length": "Mean episode length (steps)",
    "Evaluation/mean_return": "Mean evaluation return",
}

Curve = tuple[np.ndarray, np.ndarray]


def read_scalars(run_dir: str | Path, tag: str) -> Curve:
    """Return iterations and values of `tag` from the event files in `run_dir`.

    Where an iteration was written more than once, as after a resume into the same folder, the
    last value counts.

    Raises:
        ValueError: there are no event files, or they have no such tag; the tags are listed.
    """
    curves = read_all_scalars(run_dir)
    if tag not in curves:
        raise ValueError(f"Run {str(run_dir)!r}: no figure {tag!r}; {suggest(tag, curves)}")
    return curves[tag]


def read_all_scalars(run_dir: str | Path) -> dict[str, Curve]:
    """Return for each tag in the event files of `run_dir` what `read_scalars` does.

    A file that is damaged, or whose writer was killed, is read up to there, and a warning says so.

    Raises:
        ValueError: there are no event files.
    """
    run_dir = Path(run_dir)
    paths = sorted(run_dir.glob("events.out.tfevents.*"))
    if not paths:
        raise ValueError(
            f"There are no TensorBoard event files in {str(run_dir)!r}; give the folder of a run, "
            "such as logs/rsl_rl/<experiment>/<time>."
        )
    values: dict[str, dict[int, float]] = {}
    for path in paths:
        for tag, step, value in _scalar_events(path):
            curve = values.setdefault(tag, {})
            # A run that was resumed goes on from its checkpoint, before where it had got to.
            while curve and next(reversed(curve)) >= step:
                curve.popitem()
            curve[step] = value
    return {
        tag: (np.array([*curve]), np.array([*curve.values()], dtype=float))
        for tag, curve in values.items()
    }


def _scalar_events(path: Path) -> Generator[tuple[str, int, float]]:
    """Yield tag, step and value of the scalars in an event file."""
    from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader
    from tensorboard.compat.proto import event_pb2

    # Made by protobuf, whose classes have no types.
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
    run_dir: str | Path,
    output: str | Path | None = None,
    *,
    tag: str = DEFAULT_TAG,
    title: str | None = None,
) -> Path:
    """Draw the learning curve of one run.

    Args:
        run_dir: Folder of the run.
        output: The PNG; None: `<run_dir>/learning_curve.png`.
        tag: Figure to draw, as it is called in the event files.
        title: Title of the figure; None: the folder's name.

    Returns:
        The PNG.

    Raises:
        ValueError: see `read_scalars`.
    """
    run_dir = Path(run_dir)
    curve = read_scalars(run_dir, tag)
    output = run_dir / "learning_curve.png" if output is None else Path(output)

    def draw(axes: Axes) -> None:
        axes.plot(curve[0] + 1, curve[1])

    title = run_dir.resolve().name if title is None else title
    _draw_figure(draw, output, title, "Iteration", _LABELS.get(tag, tag))
    return output


def plot_seeds(
    run_dirs: Sequence[str | Path] | Mapping[str, Sequence[str | Path]],
    output: str | Path,
    *,
    tag: str = DEFAULT_TAG,
    title: str | None = None,
) -> Path:
    """Draw the mean over runs that differ in their seed, with one sample standard deviation shaded.

    A run that stopped early keeps its last value, because a task that is solved stays solved: so
    the mean is over all runs at every iteration.

    Args:
        run_dirs: Folders of the runs; or several such lists by name, one curve each.
        output: The PNG.
        tag: Figure to draw, as it is called in the event files.
        title: Title of the figure; None: the number of seeds.

    Returns:
        The PNG.

    Raises:
        ValueError: no runs are given, or see `read_scalars`.
    """
    groups = run_dirs if isinstance(run_dirs, Mapping) else {"": run_dirs}
    if not groups or not all(groups.values()):
        raise ValueError("There are no runs to draw; give the folder of at least one.")
    curves = {
        name: [
            (iterations + 1, values)
            for iterations, values in (read_scalars(run, tag) for run in runs)
        ]
        for name, runs in groups.items()
    }
    seeds = max(len(runs) for runs in groups.values())
    default = f"Mean over {seeds} seeds (shaded: one sample standard deviation)"
    return plot_curves(
        curves, output, title=default if title is None else title, ylabel=_LABELS.get(tag, tag)
    )


def plot_curves(
    groups: Mapping[str, Sequence[Curve]],
    output: str | Path,
    *,
    title: str,
    xlabel: str = "Iteration",
    ylabel: str,
    draw: Callable[[Axes], None] | None = None,
) -> Path:
    """Draw the mean over the curves of each group, with one sample standard deviation shaded.

    Args:
        groups: Curves by name of their group; without a name, a group is not in the legend.
        output: The PNG.
        title: Title of the figure.
        xlabel: Name of the first axis.
        ylabel: Name of the second axis.
        draw: Draws more, after the groups.

    Returns:
        The PNG.
    """

    def draw_all(axes: Axes) -> None:
        for name, curves in groups.items():
            x, mean, std = mean_and_std(curves)
            (line,) = axes.plot(x, mean, label=name or None)
            axes.fill_between(x, mean - std, mean + std, alpha=0.25, color=line.get_color(), lw=0)
        if draw is not None:
            draw(axes)
        if axes.get_legend_handles_labels()[1]:
            axes.legend()

    output = Path(output)
    _draw_figure(draw_all, output, title, xlabel, ylabel)
    return output


def mean_and_std(curves: Sequence[Curve]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return iterations, mean and sample standard deviation over `curves`, at every iteration any has.

    The deviation divides by n - 1, as that of few seeds must; one curve has none (0). Between its
    points a curve is linear; before its first and after its last it is constant.
    """
    iterations = np.unique(np.concatenate([curve[0] for curve in curves]))
    values = np.stack([np.interp(iterations, *curve) for curve in curves])
    std = values.std(axis=0, ddof=1) if len(values) > 1 else np.zeros(len(iterations))
    return iterations, values.mean(axis=0), std


def visible_range(values: np.ndarray) -> tuple[float, float] | None:
    """Return the range of an axis that one value in a hundred would blow up; None if none does.

    It is that of the values without the highest and the lowest hundredth, at least one of each, if the
    range of all is 20 times as wide. Values that are not finite do not count. Of fewer than 50, all do.
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


def _draw_figure(
    draw: Callable[[Axes], None], output: Path, title: str, xlabel: str, ylabel: str
) -> None:
    # The figure is made without pyplot, which would choose a window system and keep the figure.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    draw(axes)
    values = np.concatenate(
        [np.asarray(line.get_ydata(), float) for line in axes.lines] or [np.zeros(0)]
    )
    if (limits := visible_range(values)) is not None:
        axes.set_ylim(limits)
        beyond = int(((values < limits[0]) | (values > limits[1])).sum())
        axes.set_title(f"{beyond} beyond the axis", loc="right", fontsize="small")
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    axes.set_title(title)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(output, dpi=150)
