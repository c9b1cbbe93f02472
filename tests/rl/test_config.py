"""Configs: the interface's defaults and older fields."""

from __future__ import annotations

import subprocess
import sys
import warnings
from dataclasses import asdict, fields

import pytest
import torch

from mjlab.rl import (
    EvaluationCfg,
    RslRlBaseRunnerCfg,
    RslRlModelCfg,
    RslRlOnPolicyRunnerCfg,
    RslRlPpoAlgorithmCfg,
)
from mjlab.utils.torch import torch_threads, using_torch_threads


def test_defaults_are_those_of_the_interface():
    cfg = asdict(RslRlOnPolicyRunnerCfg())
    assert (cfg["seed"], cfg["num_steps_per_env"], cfg["max_iterations"]) == (42, 24, 300)
    assert cfg["obs_groups"] == {"actor": ("actor",), "critic": ("critic",)}
    assert (cfg["save_interval"], cfg["experiment_name"], cfg["run_name"]) == (50, "exp1", "")
    # mjlab 1.6 uploads by default; here metrics stay on the disk unless configured otherwise.
    assert cfg["logger"] == "tensorboard"
    assert (cfg["load_run"], cfg["load_checkpoint"]) == (".*", "model_.*.pt")
    assert cfg["critic"]["hidden_dims"] == (128, 128, 128)
    assert cfg["critic"]["distribution_cfg"] is None
    assert asdict(RslRlPpoAlgorithmCfg())["entropy_coef"] == 0.005
    assert cfg["evaluation"]["solved_return"] is None


def test_added_fields_do_not_shift_positional_arguments():
    names = [field.name for field in fields(RslRlBaseRunnerCfg)]
    assert names[-1] == "evaluation"
    assert RslRlBaseRunnerCfg(1, 2, 3).max_iterations == 3
    kw_only = {f.name for f in fields(RslRlOnPolicyRunnerCfg) if f.kw_only}
    assert kw_only == {
        "evaluation",
        "save_git_diff",
        "upload_git_diff",
        "torch_compile_mode",
        "annealing",
    }


def test_configs_do_not_share_their_parts():
    one, other = RslRlOnPolicyRunnerCfg(), RslRlOnPolicyRunnerCfg()
    one.evaluation.solved_return = 1.0
    one.obs_groups["actor"] = ()
    assert other.evaluation == EvaluationCfg()
    assert other.obs_groups["actor"] == ("actor",)


def test_older_noise_fields_become_a_distribution():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        cfg = RslRlModelCfg(stochastic=True, init_noise_std=0.5, noise_std_type="log")
    assert cfg.distribution_cfg == {
        "class_name": "GaussianDistribution",
        "init_std": 0.5,
        "std_type": "log",
    }


@pytest.fixture(autouse=True)
def _plain_environment(monkeypatch):
    monkeypatch.delenv("MJLAB_TORCH_THREADS", raising=False)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)


def test_small_networks_get_one_thread_and_large_ones_more(monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: set(range(4)), raising=False)
    assert torch_threads(9_000, 4_096) == 1
    assert torch_threads(400_000, 24_576) == 4
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    assert torch_threads(400_000, 24_576) == 2
    monkeypatch.setenv("MJLAB_TORCH_THREADS", "3")
    assert torch_threads(9_000, 4_096) == 3
    monkeypatch.setenv("MJLAB_TORCH_THREADS", "many")
    with pytest.raises(ValueError, match="MJLAB_TORCH_THREADS: .*'many'"):
        torch_threads(1, 1)


def test_processes_of_one_machine_share_its_cores(monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: set(range(6)), raising=False)
    monkeypatch.setenv("WORLD_SIZE", "3")
    assert torch_threads(400_000, 24_576) == 2
    # This is what torchrun sets, unasked.
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert torch_threads(400_000, 24_576) == 1
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    assert torch_threads(400_000, 24_576) == 2


def test_the_number_of_threads_is_put_back():
    before = torch.get_num_threads()
    with using_torch_threads(before + 1):
        assert torch.get_num_threads() == before + 1
    assert torch.get_num_threads() == before


def test_an_unknown_name_of_the_package_is_an_attribute_error():
    program = "import mjlab.rl; mjlab.rl.Nothing"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "AttributeError: module 'mjlab.rl' has no attribute 'Nothing'" in done.stderr
