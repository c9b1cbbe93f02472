"""Folder of a published policy: a run folder without logs, without other checkpoints, and without paths
of the machine that trained it.

Commands read it as they read a run. `manifest.json` lists its files; `card.py` writes the card.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mjlab.rl.checkpoint import lasting_state, naming_checkpoint, save_checkpoint
from mjlab.rl.exporter_utils import OnnxPolicy, attach_metadata_to_onnx
from mjlab.runs.checkpoint import Checkpoint
from mjlab.runs.evaluation import EVALUATION_FILE, read_evaluation
from mjlab.runs.folder import write_info
from mjlab.runs.run import POLICY_FILE, Run
from mjlab.runs.settings import Unread, differences
from mjlab.tasks.registry import load_options_cls, task_package
from mjlab.utils.os import dump_yaml, files_in, to_plain

CARD_FILE = "README.md"
"""Card, for readers of the repository."""
CLIP_FILE = "replay.mp4"
"""Clip. The Hub shows files of this name beside the card."""
MANIFEST_FILE = "manifest.json"
"""Origin of the policy, and the list of files."""

# Metadata of a run that may be published. Its command line names folders of the machine.
_INFO = ("started", "prepared", "evaluations", "ended", "iterations")
# Start of a word, and the characters of paths. Paths may hold spaces.
_WORD, _NAME = r"(?<![^\s'\"=,;(\[{<])", r"[^'\"=,;()\[\]{}<>\n]*"
_HOME = re.compile(rf"{_WORD}(?:/home/|/Users/|[A-Za-z]:\\Users\\)[^\\/]+$")
_FOLDERS = re.compile(
    rf"{_WORD}(?:(?:file://)?(?:~[\w.-]*)?/(?=[^\s/])(?:{_NAME}/)+"
    # Windows.
    rf"|(?:[A-Za-z]:[\\/]|\\\\\w)(?:{_NAME}[\\/])*)"
)


def without_paths(value: Any) -> Any:
    """Return plain data with absolute paths replaced by their last names; tensors are kept.

    Objects that only releases 1.x can read are left out.
    """
    if isinstance(value, str):
        return _FOLDERS.sub("", _HOME.sub("~", value))
    if isinstance(value, Mapping):
        items = [(k, v) for k, v in value.items() if not isinstance(v, Unread)]
        return type(value)((without_paths(key), without_paths(item)) for key, item in items)
    if type(value) in (list, tuple, set):
        return type(value)(without_paths(one) for one in value if not isinstance(one, Unread))
    return value


def write_records(checkpoint: Checkpoint, task: str, folder: Path) -> list[str]:
    """Write what commands read beside the weights, and the evaluation of the policy if there is one.

    Args:
        checkpoint: Checkpoint or exported policy in the folder of its run.
        task: Name of the task.
        folder: Folder to publish.

    Returns:
        Paths of the settings that named files of the machine.
    """
    run = Run(checkpoint.path.parent, task)
    params, settings = run.params, run.settings
    published = without_paths({**params, "settings": settings})
    info = {name: run.info[name] for name in _INFO if name in run.info}
    write_info(
        folder,
        task=task,
        profile=run.profile,
        learner=run.learner,
        **without_paths(to_plain(info)),
        settings=published["settings"],
        commit=run.commit,
        has_changed_commit=run.has_changed_commit,
        package=task_package(task),
    )
    for name in params:
        dump_yaml(folder / "params" / f"{name}.yaml", published[name])
    _write_files_of_task(run, task, folder)
    evaluation = read_evaluation(run.folder / EVALUATION_FILE, task, checkpoint.path)
    if evaluation is not None:
        named = {**evaluation, "policy": _name_of(checkpoint)}
        _write_json(folder / EVALUATION_FILE, without_paths(named))
    changed = [
        *(one.path for name in params for one in differences(published[name], params[name], name)),
        *(path for path, value in settings.items() if published["settings"].get(path) != value),
    ]
    return sorted(set(changed))


def _write_files_of_task(run: Run, task: str, folder: Path) -> None:
    """Copy the files that the options of the task read, such as motions."""
    options = load_options_cls(task)
    for pattern in () if options is None else options.run_files:
        for path in files_in(run.folder, pattern):
            copy = folder / path.relative_to(run.folder)
            copy.parent.mkdir(parents=True, exist_ok=True)
            if path.suffix == ".json":
                _write_json(copy, without_paths(json.loads(path.read_text(encoding="utf-8"))))
            else:
                shutil.copyfile(path, copy)


def write_checkpoint(checkpoint: Checkpoint, folder: Path) -> None:
    """Write the weights, the optimizer and the curricula of `checkpoint`, without episodes.

    A run resumed from there starts new episodes. Exported policies have no checkpoint.
    """
    if checkpoint.path.suffix == ".onnx":
        return
    content = dict(checkpoint.content)
    if content.get("training_state") is not None:
        with naming_checkpoint(checkpoint):
            content["training_state"] = lasting_state(content["training_state"])
    save_checkpoint(without_paths(content), folder / _name_of(checkpoint))


def _name_of(checkpoint: Checkpoint) -> str:
    """Return the name of a checkpoint in the published folder, by which commands find it."""
    if checkpoint.path.suffix == ".onnx":
        return POLICY_FILE
    number = checkpoint.number
    return f"model_{max(checkpoint.iteration - 1, 0) if number is None else number}.pt"


def clean_metadata(policy: Path) -> None:
    """Remove paths from the metadata of an exported policy, in place."""
    metadata = OnnxPolicy(policy).metadata
    attach_metadata_to_onnx(str(policy), without_paths(metadata))


def write_manifest(folder: Path, origin: Mapping[str, Any]) -> None:
    """Write the origin of the policy and the list of the files in `folder`, with their SHA-256."""
    files = {}
    for path in sorted(files_in(folder, "**/*")):
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        name = path.relative_to(folder).as_posix()
        files[name] = {"bytes": path.stat().st_size, "sha256": digest}
    _write_json(folder / MANIFEST_FILE, {"format": 1, **origin, "files": files})


def files_of(manifest: Path) -> set[str]:
    """Return the files that a manifest lists, and itself; empty for files of others."""
    try:
        listed = json.loads(manifest.read_text(encoding="utf-8"))["files"]
        return {MANIFEST_FILE, *map(str, listed)}
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def _write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
