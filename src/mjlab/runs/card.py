"""Card of a published policy: Markdown with the metadata of a model card of the Hugging Face Hub."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mjlab.rl.exporter_utils import OnnxPolicy
from mjlab.runs.evaluation import EVALUATION_FILE, evaluation_rows
from mjlab.runs.publication import CARD_FILE, CLIP_FILE, MANIFEST_FILE
from mjlab.runs.run import POLICY_FILE, Run
from mjlab.utils import hub

_LEARNERS = {"ppo": "PPO", "sac": "SAC", "distillation": "distillation"}
# Rates of an evaluation in the metadata, beside the return.
_RATES = ("success_rate", "failure_rate")


def write_card(folder: Path, name: str, origin: Mapping[str, Any], license: str | None) -> None:
    """Write the card of the policy in `folder`.

    Everything that it says about the policy's skill is in `evaluation.json`.

    Args:
        folder: Folder of the policy, complete but for its card and manifest.
        name: Name of the folder or repository, as readers pass it to `play`.
        origin: Origin of the policy; see `mjlab.deploy.bundle.origin`.
        license: License that the user states. None: none.
    """
    evaluation = None
    if (path := folder / EVALUATION_FILE).is_file():
        evaluation = json.loads(path.read_text(encoding="utf-8"))
    run = Run(folder)
    sections = [
        _front_matter(run, name, evaluation, license),
        _summary(run, folder),
        _skill(evaluation),
        _use(run, name, origin),
        _origin(run, origin),
        _interface(folder / POLICY_FILE),
    ]
    (folder / CARD_FILE).write_text("\n".join(sections), encoding="utf-8")


def _front_matter(
    run: Run, name: str, evaluation: Mapping[str, Any] | None, license: str | None
) -> str:
    import yaml

    entries: dict[str, Any] = {} if license is None else {"license": license}
    entries |= {
        "library_name": "mjlab",
        "pipeline_tag": "reinforcement-learning",
        "tags": ["mjlab", "mujoco", "robotics", "reinforcement-learning", run.task],
    }
    if evaluation is not None:
        metrics = [
            {"type": "mean_reward", "name": "mean return", "value": evaluation["mean_return"]}
        ]
        metrics += [
            {"type": rate, "name": rate.replace("_", " "), "value": evaluation[rate]}
            for rate in _RATES
            if evaluation[rate] is not None
        ]
        kind = "reinforcement-learning"
        result = {
            "task": {"type": kind, "name": kind},
            "dataset": {"type": run.task, "name": run.task},
            "metrics": metrics,
        }
        entries["model-index"] = [{"name": _short(name), "results": [result]}]
    text = yaml.safe_dump(entries, sort_keys=False, allow_unicode=True, width=1000)
    return f"---\n{text}---\n"


def _summary(run: Run, folder: Path) -> str:
    learner = "" if run.learner is None else f", trained by {_LEARNERS[run.learner]}"
    clip = f"\n[Clip]({CLIP_FILE}) of one environment of `play`.\n"
    return (
        f"# {run.task}\n\nPolicy for the task `{run.task}` of "
        f"{run.info.get('package') or 'mjlab'}{learner}.\n"
        + (clip if (folder / CLIP_FILE).is_file() else "")
    )


def _skill(evaluation: Mapping[str, Any] | None) -> str:
    if evaluation is None:
        return "## Evaluation\n\nNot evaluated: its skill is unknown.\n"
    rows = _table(("measured", "mean over episodes", "95 % interval"), evaluation_rows(evaluation))
    notes = [
        *([f"Success: {d}."] if (d := evaluation["success_definition"]) else []),
        *(f"Setting: {line}" for line in evaluation.get("settings", ())),
        *evaluation["notes"],
    ]
    return (
        f"## Evaluation\n\n`mjlab evaluate`, {evaluation['num_episodes']:,} episodes, mean length "
        f"{evaluation['mean_length']:.1f} steps, seed {evaluation['seed']}, {evaluation['physics']}; "
        f"all values are in [{EVALUATION_FILE}]({EVALUATION_FILE}). The return is the sum over the "
        f"episode of the weighted reward before scaling by the time step.\n\n{rows}"
        + (f"\n{_bullets(notes)}" if notes else "")
    )


def _use(run: Run, name: str, origin: Mapping[str, Any]) -> str:
    package = run.info.get("package")
    # The package index has another package of this name.
    needs = f"{origin['package']} (from a clone, not from the package index)"
    needs += "" if package is None else f", {package}"
    needs += ", and the extra `mjlab[hub]`" if name.startswith(hub.PREFIX) else ""
    name = shlex.quote(name)
    return (
        f"## Use\n\nWith {needs}:\n\n```bash\nuv run mjlab play {name}\nuv run mjlab evaluate {name}\n"
        f"uv run mjlab deploy {name} --output bundle   # runs without mjlab and torch\n```\n"
    )


def _origin(run: Run, origin: Mapping[str, Any]) -> str:
    changed = ", with uncommitted changes" if run.has_changed_commit else ""
    values = {
        "task": f"`{run.task}`",
        "profile": run.profile and f"`{run.profile}`",
        "learner": run.learner and _LEARNERS[run.learner],
        "seed": run.seed,
        "iterations": origin.get("iteration"),
        "environments": run.num_envs,
        "commit of the task": run.commit and f"`{run.commit}`{changed}",
        "exported with": f"{origin['package']}, MuJoCo {origin['mujoco']}",
    }
    rows = [(key, str(value)) for key, value in values.items() if value is not None]
    settings = [f"`{path}`: `{value}`" for path, value in run.settings.items()]
    return (
        f"## Training\n\n{_table(('', ''), rows)}"
        + (f"\nSettings that differ from the task:\n\n{_bullets(settings)}" if settings else "")
        + f"\n`params/` has all settings, [{MANIFEST_FILE}]({MANIFEST_FILE}) the files and their SHA-256.\n"
    )


def _interface(policy: Path) -> str:
    metadata = OnnxPolicy(policy).metadata
    names = {
        "observations": metadata.get("observation_names"),
        "actions": metadata.get("action_target_names"),
        "control step": f"{metadata['step_dt']} s" if "step_dt" in metadata else None,
    }
    rows = [(key, value.replace(",", ", ")) for key, value in names.items() if value]
    return (
        f"## Network\n\n[{POLICY_FILE}]({POLICY_FILE}) holds the network and its normalization; its metadata "
        f"have scales, gains and joints.\n\n{_table(('', ''), rows)}"
    )


def _short(name: str) -> str:
    return hub.repository(name).name.partition("/")[2] if name.startswith(hub.PREFIX) else name


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    cells = ([cell.replace("|", "\\|") for cell in line] for line in lines)
    return "".join(f"| {' | '.join(line)} |\n" for line in cells)


def _bullets(lines: Iterable[str]) -> str:
    return "".join(f"- {line}\n" for line in lines)
