"""Commands with runners, algorithms and networks of other packages."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from commands import SMALL, TASK
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.runners import OnPolicyRunner

from mjlab.rl import MjlabOnPolicyRunner
from mjlab.runs import Run
from mjlab.scripts import train
from mjlab.tasks import registry

OWN = "Test-Own"
SEEN: dict = {}


class OwnRunner:
    """Runner with the methods that mjlab 1.6 calls, and files in its own format."""

    fails = False

    def __init__(self, env, train_cfg, log_dir=None, device="cpu"):
        self.env, self.log_dir = env, log_dir
        SEEN["cfg"] = train_cfg

    def add_git_repo_to_log(self, path):
        pass

    def learn(self, *, num_learning_iterations, init_at_random_ep_len):
        SEEN["learned"] = num_learning_iterations
        # Not plain data, so that only this class reads it.
        torch.save(SimpleNamespace(gain=0.5), f"{self.log_dir}/model_{num_learning_iterations}.pt")
        if self.fails:
            raise RuntimeError("the robot is on fire")

    def load(self, path, load_cfg=None, strict=True, map_location=None):
        SEEN["loaded"] = torch.load(path, weights_only=False).gain

    def save(self, path):
        pass

    def get_inference_policy(self, device=None):
        return lambda observations: torch.zeros(self.env.num_envs, self.env.num_actions)


class FailingRunner(OwnRunner):
    """`OwnRunner` whose training ends with an error."""

    fails = True


class RslRunner(OnPolicyRunner):
    """rsl_rl's runner, with the changes to the config that it needs."""

    def __init__(self, env, train_cfg, log_dir=None, device="cpu"):
        for network in ("actor", "critic"):
            for key in ("cnn_cfg", "rnn_type", "rnn_hidden_dim", "rnn_num_layers"):
                del train_cfg[network][key]
        super().__init__(env, train_cfg, log_dir, device)


class OwnModel(MLPModel):
    """Network with the arguments of mjlab 1.6's `MLPModel`."""

    def __init__(
        self, obs, obs_groups, obs_set, output_dim, hidden_dims=(8,), activation="elu",
        obs_normalization=False, distribution_cfg=None,
    ):  # fmt: skip
        super().__init__(
            obs, obs_groups, obs_set, output_dim, hidden_dims, activation, obs_normalization,
            distribution_cfg,
        )  # fmt: skip


class OwnPPO(PPO):
    """PPO with the arguments of mjlab 1.6's `PPO`."""

    def __init__(
        self, actor, critic, storage, num_learning_epochs=5, num_mini_batches=4, clip_param=0.2,
        gamma=0.99, lam=0.95, value_loss_coef=1.0, entropy_coef=0.01, learning_rate=1e-3,
        max_grad_norm=1.0, optimizer="adam", use_clipped_value_loss=True, schedule="adaptive",
        desired_kl=0.01, normalize_advantage_per_mini_batch=False, device="cpu", rnd_cfg=None,
        symmetry_cfg=None, multi_gpu_cfg=None,
    ):  # fmt: skip
        super().__init__(
            actor, critic, storage, num_learning_epochs, num_mini_batches, device=device
        )


@pytest.fixture
def own_task(monkeypatch):
    """Return a function that registers the cartpole with a runner or changed learner config."""
    registry.list_tasks()
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))

    def register(runner_cls=None, **classes):
        rl_cfg = registry.load_rl_cfg(TASK)
        for part, class_name in classes.items():
            getattr(rl_cfg, part).class_name = class_name
        registry.register_mjlab_task(
            OWN, registry.load_env_cfg(TASK), rl_cfg=rl_cfg, runner_cls=runner_cls
        )

    return register


def trains(run, logs, *flags):
    """Train the own task; return the outcome and the run folder."""
    argv = [OWN, *SMALL, "--log-root", str(logs), "--agent.max-iterations", "2", *flags]
    outcome = run("train", *argv)
    runs = sorted((logs / "cartpole").glob("*"))
    return outcome, runs[-1] if runs else None


def test_a_runner_needs_no_attributes(run, own_task, tmp_path):
    own_task(OwnRunner)
    outcome, folder = trains(run, tmp_path, "--live", "True")
    assert outcome.status == 0, outcome.err
    assert SEEN["learned"] == 2
    assert "no observers" in outcome.err
    info = Run(folder).info
    assert (info["ended"], info["iterations"]) == ("finished", 2)
    assert "use_mixed_precision" not in SEEN["cfg"]["algorithm"]
    assert SEEN["cfg"]["actor"]["cnn_cfg"] is None


def test_files_of_a_runner_resume_and_play(run, own_task, tmp_path):
    own_task(OwnRunner)
    _, first = trains(run, tmp_path)
    SEEN.clear()
    outcome, folder = trains(run, tmp_path, "--agent.resume", "True")
    assert outcome.status == 0, outcome.err
    # As rsl_rl's, it trains this number of further iterations.
    assert SEEN["loaded"] == 0.5
    assert SEEN["learned"] == 2
    assert folder != first
    argv = [OWN, "--log-root", str(tmp_path), "--device", "cpu"]
    for flags in (
        ("play", *argv, "--viewer", "none", "--num-steps", "2"),
        ("evaluate", *argv, "--num-episodes", "2", "--env.episode-length-s", "0.1"),
    ):
        SEEN.clear()
        outcome = run(*flags)
        assert outcome.status == 0, outcome.err
        assert SEEN["loaded"] == 0.5


def test_main_returns_after_training(own_task, tmp_path, monkeypatch):
    own_task(OwnRunner)
    argv = ["train", OWN, *SMALL, "--log-root", str(tmp_path), "--agent.max-iterations", "3"]
    monkeypatch.setattr("sys.argv", argv)
    train.main()
    assert SEEN["learned"] == 3


def test_a_failed_runner_keeps_its_folder(run, own_task, tmp_path):
    own_task(FailingRunner)
    outcome, folder = trains(run, tmp_path)
    assert outcome.status == 1
    assert "on fire" in outcome.err
    assert __file__ in outcome.err
    assert Run(folder).info["ended"] == "failed"
    assert (folder / "model_2.pt").exists()


def test_a_runner_of_rsl_rl_trains_and_resumes(run, own_task, tmp_path):
    own_task(RslRunner)
    outcome, folder = trains(run, tmp_path)
    assert outcome.status == 0, outcome.err
    assert Run(folder).info["iterations"] == 1
    outcome, folder = trains(run, tmp_path, "--agent.resume", "True")
    assert outcome.status == 0, outcome.err
    assert sorted(path.name for path in folder.glob("model_*.pt"))[-1] == "model_2.pt"
    argv = [OWN, "--log-root", str(tmp_path), "--device", "cpu", "--viewer", "none"]
    outcome = run("play", *argv, "--num-steps", "2")
    assert outcome.status == 0, outcome.err


@pytest.mark.parametrize("runner_cls", [MjlabOnPolicyRunner, RslRunner])
def test_algorithms_and_networks_of_releases_train(run, own_task, tmp_path, runner_cls):
    own_task(
        runner_cls,
        algorithm=f"{__name__}:OwnPPO",
        actor=f"{__name__}:OwnModel",
        critic=f"{__name__}:OwnModel",
    )
    outcome, _ = trains(run, tmp_path)
    assert outcome.status == 0, outcome.err


def test_a_changed_setting_reaches_the_algorithm(run, own_task, tmp_path):
    own_task(OwnRunner)
    flags = ("--agent.algorithm.use-mixed-precision", "True", "--agent.save-git-diff", "False")
    outcome, _ = trains(run, tmp_path, *flags)
    assert outcome.status == 0, outcome.err
    assert SEEN["cfg"]["algorithm"]["use_mixed_precision"] is True
    assert SEEN["cfg"]["save_git_diff"] is False
    assert "upload_git_diff" not in SEEN["cfg"]
