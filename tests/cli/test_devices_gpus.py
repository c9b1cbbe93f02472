"""One process for each GPU: which GPUs a run has, and the device of each process."""

from __future__ import annotations

import sys

import pytest
import torch
from commands import TASK

from mjlab.cli.devices import gpus_to_share, training_device
from mjlab.scripts import train
from mjlab.scripts.train import TrainConfig
from mjlab.utils.errors import UserError
from mjlab.utils.processes import ProcessRank


@pytest.fixture
def gpus(monkeypatch):
    """Return a function that sets the number of GPUs and what is visible."""

    def configure(count: int, visible: str | None = None) -> None:
        monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
        monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
        if visible is not None:
            monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)

    # So that it is put back, whatever is set.
    monkeypatch.setenv("MUJOCO_EGL_DEVICE_ID", "0")
    monkeypatch.delenv("MUJOCO_EGL_DEVICE_ID")
    return configure


def config(**changes) -> TrainConfig:
    cfg = TrainConfig.from_task(TASK)
    for name, value in changes.items():
        setattr(cfg, name, value)
    return cfg


@pytest.mark.parametrize(
    ("visible", "changes", "expected"),
    [
        (None, {"gpu_ids": [2, 0]}, [2, 0]),
        (None, {"gpu_ids": "all"}, [0, 1, 2, 3]),
        ("5,7", {"gpu_ids": "all"}, [5, 7]),
        (None, {"gpu_ids": [1]}, []),
        (None, {}, []),
        (None, {"gpu_ids": None}, []),
        ("", {"gpu_ids": [0, 1]}, []),
        (None, {"gpu_ids": [0, 1], "device": "cpu"}, []),
    ],
)
def test_the_gpus_of_a_run(gpus, visible, changes, expected):
    gpus(4, visible)
    assert gpus_to_share(config(**changes)) == expected


def test_a_process_that_was_started_for_a_gpu_starts_no_others(gpus, monkeypatch):
    gpus(2)
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "1")
    assert gpus_to_share(config(gpu_ids="all")) == []


def test_train_starts_a_process_for_each_gpu_with_the_same_flags(gpus, run, monkeypatch):
    gpus(4, "4,5,6,7")
    started = []
    monkeypatch.setattr(train, "launch_workers", lambda *args: started.append(args))
    outcome = run("train", TASK, "--gpu-ids", "[3,1]", "--num-envs", "8")
    assert outcome.status == 0, outcome.err
    ((command, count, environment),) = started
    flags = ["--gpu-ids", "[3,1]", "--num-envs", "8", "--gpu-ids", "all"]
    assert command == [sys.executable, "-m", "mjlab.scripts.train", TASK, *flags]
    assert (count, environment) == (2, {"CUDA_VISIBLE_DEVICES": "7,5"})
    assert run("train", TASK, "--gpu-ids", "all", "--agent.save-interval", "0").status == 1
    assert len(started) == 1


@pytest.mark.parametrize(
    ("visible", "changes", "rank", "device", "egl"),
    [
        (None, {}, (0, 1, 0, 1), "cuda:0", "0"),
        (None, {"gpu_ids": [3]}, (0, 1, 0, 1), "cuda:3", "3"),
        ("3,2", {"gpu_ids": [1]}, (0, 1, 0, 1), "cuda:1", "2"),
        ("3,2", {"device": "cuda"}, (0, 1, 0, 1), "cuda:0", "3"),
        ("3,2", {"gpu_ids": "all"}, (1, 2, 1, 2), "cuda:1", "2"),
        (None, {}, (6, 8, 2, 4), "cuda:2", "2"),
        (None, {"device": "cuda"}, (1, 2, 1, 2), "cuda:1", "1"),
        (None, {"gpu_ids": [3, 1]}, (1, 2, 1, 2), "cuda:1", "1"),
        (None, {"device": "cpu"}, (1, 2, 1, 2), "cpu", None),
        (None, {"gpu_ids": None}, (1, 2, 1, 2), "cpu", None),
        ("", {}, (1, 2, 1, 2), "cpu", None),
    ],
)
def test_the_device_of_each_process(gpus, visible, changes, rank, device, egl):
    import os

    gpus(4, visible)
    assert training_device(config(**changes), ProcessRank(*rank)) == device
    assert os.environ.get("MUJOCO_EGL_DEVICE_ID") == egl


@pytest.mark.parametrize(
    ("changes", "rank", "message"),
    [
        ({}, (2, 3, 2, 3), "at most 2 processes .* got 3"),
        ({"device": "cuda:1"}, (0, 2, 0, 2), "--device cuda:1: expected one GPU for each of the 2"),
        ({"gpu_ids": [0, 1]}, (0, 1, 0, 1), "--gpu-ids: expected one GPU"),
    ],
)
def test_processes_without_a_gpu_each_are_refused(gpus, changes, rank, message):
    gpus(2)
    with pytest.raises(UserError, match=message):
        training_device(config(**changes), ProcessRank(*rank))
