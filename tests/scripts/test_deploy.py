"""`mjlab deploy`: the policy that it finds, and the folder that it writes."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest

from mjlab.rl.exporter_utils import action_limit
from mjlab.scripts import deploy

QUICK = ("--steps", "4")


def contract_of(folder: Path) -> dict:
    """Return the contract of a bundle."""
    return json.loads((folder / "contract.json").read_text())


def test_a_run_is_deployed_from_its_last_checkpoint(run, trained, tmp_path):
    recorded = shutil.copytree(trained, tmp_path / "runs" / trained.name)
    shutil.rmtree(recorded / "git", ignore_errors=True)
    (recorded / "git").mkdir()
    (recorded / "git" / "tasks.diff").write_text("--- git commit ---\n0123abcd\n")
    folder = tmp_path / "out" / "bundle"
    outcome = run("deploy", str(recorded), "--output", str(folder), *QUICK)
    assert outcome.status == 0, outcome.err
    source = contract_of(folder)["source"]
    assert source["task"] == "Mjlab-Cartpole-Swingup"
    assert source["run"] == trained.name
    # The commit of the training, not of the package that deploys.
    assert source["commit"] == "0123abcd"
    assert source["package_commit"] != "0123abcd"
    assert source["checkpoint"] == "model_1.pt"
    assert source["seed"] == 7
    assert source["iteration"] == 2
    names = {path.name for path in folder.iterdir()}
    assert names >= {"contract.json", "policy.onnx", "golden.npz", "golden.csv", "README.md"}
    assert names >= {"runtime.py", "simulate.py", "scene", "robot"}
    # Nothing else is left beside it.
    assert [path.name for path in folder.parent.iterdir()] == ["bundle"]


def test_a_checkpoint_and_its_export_are_the_same_policy(run, trained, tmp_path):
    (exported,) = trained.glob("*.onnx")
    actions = []
    for name, policy in (("pt", trained / "model_1.pt"), ("onnx", exported)):
        outcome = run("deploy", str(policy), "--output", str(tmp_path / name), *QUICK)
        assert outcome.status == 0, outcome.err
        actions.append(np.load(tmp_path / name / "golden.npz")["action"])
    np.testing.assert_allclose(*actions, atol=1e-6)


def test_settings_of_the_run_are_in_the_bundle(run, train, tmp_path):
    trained = train(tmp_path / "logs", 1, "--env.decimation", "4", "--agent.clip-actions", "2.5")
    outcome = run("deploy", str(trained), "--output", str(tmp_path / "bundle"), *QUICK)
    assert outcome.status == 0, outcome.err
    contract = contract_of(tmp_path / "bundle")
    assert contract["rates"]["decimation"] == 4
    # The network clips, so that programs need not.
    assert contract["policy"]["clip"] is None
    assert action_limit(tmp_path / "bundle" / "policy.onnx") == 2.5


def test_a_signal_leaves_nothing(run, trained, tmp_path, monkeypatch):
    def stop(*_) -> None:
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(deploy, "export_policy", stop)
    outcome = run("deploy", str(trained), "--output", str(tmp_path / "out" / "bundle"))
    assert outcome.status == 128 + signal.SIGTERM
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.parametrize("flags", [(), ("--overwrite",)])
def test_a_folder_of_others_is_not_replaced(run, trained, tmp_path, flags):
    (tmp_path / "bundle").mkdir()
    (tmp_path / "bundle" / "mine.txt").write_text("mine")
    outcome = run("deploy", str(trained), "--output", str(tmp_path / "bundle"), *flags)
    assert outcome.status == 1
    assert "not empty" in outcome.message
    assert (tmp_path / "bundle" / "mine.txt").exists()


def test_unknown_state_of_curricula_is_printed(run, tmp_path):
    """The ranges of commands in the contract are those of the curricula."""
    outcome = run("deploy", "go1", "--output", str(tmp_path / "bundle"), *QUICK)
    assert outcome.status == 0, outcome.err
    assert "does not hold the state of the task's curricula" in outcome.err


def test_a_bundle_is_replaced_on_request(run, trained, tmp_path):
    flags = ("--output", str(tmp_path / "bundle"), *QUICK)
    (tmp_path / "bundle").mkdir()
    (tmp_path / "bundle" / "contract.json").write_text("{}")
    assert "--overwrite" in run("deploy", str(trained), *flags).message
    assert run("deploy", str(trained), *flags, "--overwrite").status == 0
    assert contract_of(tmp_path / "bundle")["golden"]["steps"] == 4


def test_only_trained_policies_are_deployed(run, trained, tmp_path):
    output = ("--output", str(tmp_path / "bundle"))
    outcome = run("deploy", str(trained), "--agent", "zero", *output)
    assert outcome.status == 1
    assert "--agent" in outcome.message


@pytest.mark.parametrize("policy", ["nowhere", "."])
def test_a_policy_that_is_not_found(run, tmp_path, monkeypatch, policy):
    monkeypatch.chdir(tmp_path)
    outcome = run("deploy", policy)
    assert outcome.status == 1
    assert policy in outcome.message
