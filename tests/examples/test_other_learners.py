"""The examples that solve the swing-up with other libraries."""

from __future__ import annotations

import pytest
import torch
from example_files import EXAMPLES, load_example


@pytest.mark.slow
@pytest.mark.parametrize(
    ("library", "example"),
    [("stable_baselines3", "sb3_swing_up"), ("skrl", "skrl_swing_up")],
)
def test_the_swing_up_is_solved(library, example):
    pytest.importorskip(library)
    assert load_example(example).train(seed=1)[0] >= 900.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("library", "example"),
    [
        ("gymnasium", "gymnasium_cartpole"),
        ("stable_baselines3", "sb3_cartpole"),
        ("skrl", "skrl_cartpole"),
        ("torchrl", "torchrl_cartpole"),
    ],
)
def test_short_examples_run(library, example, monkeypatch, tmp_path):
    pytest.importorskip(library)
    # Some write their logs here.
    monkeypatch.chdir(tmp_path)
    threads = torch.get_num_threads()
    load_example(example).train(num_envs=4, iterations=1)
    torch.set_num_threads(threads)
    lines = (EXAMPLES / f"{example}.py").read_text(encoding="utf-8").splitlines()
    assert sum(map(bool, lines)) < 40
