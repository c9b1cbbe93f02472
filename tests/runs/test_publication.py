"""Files of a published policy: what they hold, and what stays on the machine."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mjlab.runs import Checkpoint, Run
from mjlab.runs.publication import files_of, without_paths, write_records
from mjlab.runs.settings import Unread
from mjlab.tasks.tracking.motion_sources import record_motions, recorded_motions

FOLDERS = ("/home/jane", "/home/Jane Doe/my files", "/data/private", "C:\\Users\\jane", "D:/private/jane",
           "~jane/runs", "\\\\server\\jane")  # fmt: skip
FORMS = ("{}", "PosixPath('{}')", "a.npz,{}", "--motion-file={}", "file://{}", "[{}]", 'say "{}"')


@given(folder=st.sampled_from(FOLDERS), form=st.sampled_from(FORMS), depth=st.integers(0, 3))
def test_folders_of_the_machine_are_left_out(folder, form, depth):
    if "file:" in form and not folder.startswith("/"):
        return
    separator = "\\" if "\\" in folder else "/"
    text = value = form.format(f"{folder}{separator}dance.npz")
    for _ in range(depth):
        value = {text: [1.0, (value,)], "flag": None}
    found = repr(without_paths(value))
    assert "dance.npz" in found
    assert not any(part in found for part in ("jane", "Jane", "private", "server"))


@pytest.mark.parametrize("folder", ["/home/jane", "/Users/jane", "C:\\Users\\jane"])
def test_home_folders_are_left_out(folder):
    assert "jane" not in without_paths(folder)


@pytest.mark.parametrize(
    "text",
    ["robot/.*_foot", ".*/foot/x", r"\d+_\w+", r"(?!left)/foot", "my_robots.mdp:speed", "m/s", "1 / 2",
     "cartpole/side", "/foot", "a, b", "", "dance.npz"],
)  # fmt: skip
def test_other_texts_are_kept(text):
    assert without_paths(text) == text


def test_tensors_and_types_are_kept():
    tensor = torch.zeros(2)
    value = {"a": (1, [tensor, {2}]), 3: None, "b": Unread("python/name:f")}
    found = without_paths(value)
    assert found == {"a": (1, [tensor, {2}]), 3: None}
    assert found["a"][1][0] is tensor


def test_motions_are_published_without_their_sources(tmp_path):
    task = "Mjlab-Tracking-Flat-Unitree-G1"
    run, folder = tmp_path / "jane" / "run", tmp_path / "published"
    folder.mkdir()
    motion = tmp_path / "jane" / "dance.npz"
    motion.parent.mkdir()
    np.savez(motion, fps=np.array([50.0]), joint_pos=np.zeros((3, 29)))
    run.mkdir()
    record_motions([motion], run)
    setting = {"env.commands.motion.motion_file": str(motion), "env.decimation": 2}
    (run / "run.json").write_text(
        json.dumps({"task": task, "settings": setting, "command": [str(run)]})
    )
    changed = write_records(Checkpoint(run / "model_0.pt"), task, folder)
    assert changed == ["env.commands.motion.motion_file"]
    assert Run(folder).settings == {**setting, "env.commands.motion.motion_file": "dance.npz"}
    assert [path.name for path in recorded_motions(folder)] == ["dance.npz"]
    texts = [
        path.read_text() for path in folder.rglob("*") if path.suffix != ".npz" and path.is_file()
    ]
    assert not any("jane" in text for text in texts)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"files": 3}'])
def test_manifests_of_others_list_nothing(tmp_path, text):
    path = Path(tmp_path / "manifest.json")
    path.write_text(text)
    assert files_of(path) == set()
