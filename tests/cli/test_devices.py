"""The torch device of a command."""

from __future__ import annotations

import pytest

from mjlab.cli.devices import gpus_to_share, resolve_device, training_device
from mjlab.cli.train_config import TrainConfig, check_typed_flags
from mjlab.utils.errors import UserError
from mjlab.utils.processes import process_rank


@pytest.mark.parametrize(("asked", "device"), [("cpu", "cpu"), ("cuda", "cuda:0")])
def test_the_device_is_the_one_asked_for(asked, device, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    assert resolve_device(asked) == device


@pytest.mark.parametrize(("gpu", "device"), [(False, "cpu"), (True, "cuda:0")])
def test_without_a_wish_the_device_is_a_gpu_where_there_is_one(gpu, device, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: gpu)
    assert resolve_device(None) == device


def test_a_device_that_cannot_be_used_is_refused_with_what_to_do(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(UserError, match=r"--device cuda:1.* no CUDA GPU .* --device cpu"):
        resolve_device("cuda:1")
    with pytest.raises(UserError, match=r"--device: expected cpu, cuda.* got 'gpu'"):
        resolve_device("gpu")


@pytest.mark.parametrize(
    ("flags", "times"), [({}, 1), ({"device": "cpu"}, 0), ({"gpu_ids": None}, 0)]
)
def test_a_missing_gpu_is_told_once(flags, times, monkeypatch, capsys, caplog):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    cfg = TrainConfig.from_task("Mjlab-Cartpole-Swingup")
    for name, value in flags.items():
        setattr(cfg, name, value)
    with caplog.at_level("INFO"):
        check_typed_flags(cfg, [])
        assert gpus_to_share(cfg) == []
        assert training_device(cfg, process_rank()) == "cpu"
    told = capsys.readouterr()
    assert (told.out + told.err + caplog.text).count("GPU") == times
