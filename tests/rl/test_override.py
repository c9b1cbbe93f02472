"""Resume under other settings: each acts, or is an error."""

from __future__ import annotations

import copy
import functools
import math
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import pytest
import torch
from rl_fake_env import FakeEnv, FakeEnvCfg, runner_cfg
from tensordict import TensorDict

from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.rl.checkpoint import CheckpointError
from mjlab.rl.config import (
    RslRlDistillationAlgorithmCfg,
    RslRlDistillationRunnerCfg,
    RslRlModelCfg,
    RslRlOffPolicyRunnerCfg,
    RslRlOnPolicyRunnerCfg,
    RslRlSacAlgorithmCfg,
    gaussian_distribution,
)
from mjlab.utils.errors import UserError

Settings = dict[str, Any]


def mirror(env: Any, obs: Any = None, actions: Any = None) -> tuple[Any, Any]:
    """Turn the fake environment upside down."""
    if obs is not None:
        obs = torch.cat([obs, TensorDict({k: -v for k, v in obs.items()}, obs.batch_size)])
    if actions is not None:
        actions = torch.cat([actions, -actions])
    return obs, actions


def ppo_cfg() -> Settings:
    cfg = runner_cfg()
    # Tight bounds, so that the schedule and the clipping of values act within an iteration.
    cfg["algorithm"] |= {"desired_kl": 1e-5, "clip_param": 0.01}
    return cfg


def sac_cfg() -> Settings:
    algorithm = RslRlSacAlgorithmCfg(
        batch_size=32, num_updates=2, replay_steps=20, learning_starts=3, policy_delay=2
    )
    cfg = RslRlOffPolicyRunnerCfg(num_steps_per_env=5, save_interval=2, algorithm=algorithm)
    cfg.actor.hidden_dims = cfg.critic.hidden_dims = (16, 16)
    return asdict(cfg)


def student_cfg() -> Settings:
    groups = {"student": ("critic",), "teacher": ("actor",)}
    cfg = RslRlDistillationRunnerCfg(num_steps_per_env=6, save_interval=2, obs_groups=groups)
    cfg.student = RslRlModelCfg((16,), distribution_cfg=gaussian_distribution(0.3))
    cfg.teacher = RslRlModelCfg((8,), distribution_cfg=gaussian_distribution())
    cfg.algorithm = RslRlDistillationAlgorithmCfg(gradient_length=3)
    return asdict(cfg)


CFGS = {"ppo": ppo_cfg, "sac": sac_cfg, "distillation": student_cfg}


class Run:
    """A run of two iterations, resumed for one more under other settings."""

    def __init__(self, learner: str, folder: Path, **changes: Any) -> None:
        self.learner, self.changes = learner, changes
        first = self._runner({}, folder)
        if learner == "distillation":
            first.alg.teacher_loaded = True
        first.learn(2)
        self.path = str(folder / "model_1.pt")

    def _runner(self, settings: Settings, folder: Path | None = None) -> Any:
        cfg = copy.deepcopy(CFGS[self.learner]())
        for name, value in {**self.changes, **settings}.items():
            *holders, last = name.split(".")
            holder = cfg
            for part in holders:
                holder = holder[part]
            holder[last] = value
        torch.manual_seed(3)
        env = RslRlVecEnvWrapper(FakeEnv(FakeEnvCfg()))
        return MjlabOnPolicyRunner(env, cfg, None if folder is None else str(folder))

    def resume(self, settings: Settings, typed: bool = True) -> Any:
        runner = self._runner(settings)
        runner.load(self.path)
        if typed:
            runner.override(settings)
        return runner

    def learned(self, settings: Settings, typed: bool = True) -> dict[str, torch.Tensor]:
        """Return the weights and learning rates after the iteration."""
        runner = self.resume(settings, typed)
        runner.learn(3)
        saved = runner.alg.save()
        found = {
            f"{part}.{name}": value.clone()
            for part in ("actor", "critic", "student")
            for name, value in saved.get(f"{part}_state_dict", {}).items()
        }
        groups = saved["optimizer_state_dict"]["param_groups"]
        return {**found, "rates": torch.tensor([group["lr"] for group in groups])}

    @functools.cached_property
    def unchanged(self) -> dict[str, torch.Tensor]:
        """Weights and learning rates after an iteration under the settings of the run."""
        return self.learned({})


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> dict[str, Run]:
    return {learner: Run(learner, tmp_path_factory.mktemp(learner)) for learner in CFGS}


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(value, other[name]) for name, value in one.items())


# Settings by learner with another value: all change the weights of the next iteration.

ACTING: dict[str, Settings] = {
    "ppo": {
        "seed": 5,
        "num_steps_per_env": 7,
        "actor.activation": "tanh",
        "critic.activation": "tanh",
        "actor.distribution_cfg.init_std": 0.3,
        "algorithm.num_learning_epochs": 3,
        "algorithm.num_mini_batches": 4,
        "algorithm.learning_rate": 1e-5,
        "algorithm.schedule": "fixed",
        "algorithm.gamma": 0.5,
        "algorithm.lam": 0.5,
        "algorithm.entropy_coef": 0.5,
        "algorithm.desired_kl": 0.5,
        "algorithm.max_grad_norm": 1e-3,
        "algorithm.value_loss_coef": 20.0,
        "algorithm.use_clipped_value_loss": False,
        "algorithm.clip_param": 1e-3,
        "algorithm.normalize_advantage_per_mini_batch": True,
        "algorithm.optimizer": "sgd",
        "algorithm.symmetry_cfg": {
            "data_augmentation_func": "test_override:mirror",
            "use_data_augmentation": True,
        },
        "algorithm.use_mixed_precision": True,
        "annealing": ((0, 0.1),),
    },
    "sac": {
        "seed": 5,
        "num_steps_per_env": 7,
        "actor.activation": "tanh",
        "critic.activation": "tanh",
        "algorithm.batch_size": 16,
        "algorithm.num_updates": 3,
        "algorithm.replay_steps": 7,
        "algorithm.learning_starts": 13,
        "algorithm.gamma": 0.5,
        "algorithm.num_steps_return": 3,
        "algorithm.value_range": (-2.0, 9.0),
        "algorithm.tau": 0.5,
        "algorithm.pessimistic": True,
        "algorithm.policy_delay": 1,
        "algorithm.actor_learning_rate": 1e-5,
        "algorithm.critic_learning_rate": 1e-5,
        "algorithm.learning_rate_factor": ((0, 0.5),),
        "algorithm.weight_decay": 0.5,
        "algorithm.init_alpha": 0.5,
        "algorithm.alpha_learning_rate": 1e-5,
        "algorithm.alpha_range": (0.3, 0.4),
        "algorithm.target_std": 0.9,
        "algorithm.mean_penalty": 3.0,
        "algorithm.policy_average": 0.1,
        "algorithm.noise_hold": 4,
        "algorithm.symmetry_cfg": {"data_augmentation_func": "test_override:mirror"},
        "algorithm.use_mixed_precision": True,
    },
    "distillation": {
        "seed": 5,
        "num_steps_per_env": 9,
        "student.activation": "tanh",
        "teacher.activation": "tanh",
        "student.distribution_cfg.init_std": 0.9,
        "algorithm.num_learning_epochs": 2,
        "algorithm.gradient_length": 2,
        "algorithm.learning_rate": 1e-5,
        "algorithm.max_grad_norm": 1e-3,
        "algorithm.loss_type": "huber",
        "algorithm.teacher_iterations": 4,
        "algorithm.optimizer": "rmsprop",
        "algorithm.use_mixed_precision": True,
    },
}
TAUGHT = {
    "algorithm.teacher": "actor",
    "algorithm.teacher_steps": 30,
    "algorithm.imitation": ((0, 1.0),),
}
# Settings by learner that the networks were trained with: another value is an error.
FIXED: dict[str, Settings] = {
    "ppo": {
        "obs_groups.actor": ("critic",),
        "actor.hidden_dims": (9,),
        "critic.hidden_dims": (9,),
        "actor.obs_normalization": False,
        "critic.obs_normalization": False,
        "actor.distribution_cfg.std_type": "log",
    },
    "sac": {
        "obs_groups.actor": ("critic",),
        "actor.hidden_dims": (9, 9),
        "critic.hidden_dims": (9, 9),
        "actor.obs_normalization": False,
        "critic.obs_normalization": False,
        "actor.distribution_cfg.init_std": 0.4,
        "algorithm.action_bounds": "joint_ranges",
        "algorithm.num_atoms": 51,
    },
    "distillation": {
        "obs_groups.student": ("actor",),
        "student.hidden_dims": (9,),
        "teacher.hidden_dims": (9,),
        "student.obs_normalization": True,
        "teacher.obs_normalization": True,
    },
}
# Settings of the session, and those of image encoders, recurrent networks and classes, whose weights
# have other shapes. The environment clips actions; `train` compares the teacher with that of the run.
OTHERS = {
    "clip_actions",
    "max_iterations", "save_interval", "experiment_name", "run_name", "logger", "wandb_project",
    "wandb_tags", "resume", "load_run", "load_checkpoint", "upload_model", "save_git_diff",
    "upload_git_diff", "evaluation", "class_name", "torch_compile_mode", "teacher_checkpoint",
    "algorithm.class_name", "algorithm.save_replay", "algorithm.share_cnn_encoders",
}  # fmt: skip
OF_NETWORKS = {"cnn_cfg", "rnn_type", "rnn_hidden_dim", "rnn_num_layers", "class_name"}
# The critic and the teacher have no noise.
OTHERS |= {f"{network}.distribution_cfg" for network in ("critic", "teacher")}


def cases(table: dict[str, Settings]) -> list[tuple[str, str]]:
    return [(learner, name) for learner, settings in table.items() for name in settings]


@pytest.mark.parametrize(("learner", "name"), cases(ACTING), ids=lambda part: part)
def test_a_setting_typed_on_resume_acts(runs, learner, name):
    run = runs[learner]
    assert not same(run.learned({name: ACTING[learner][name]}), run.unchanged)


@pytest.mark.parametrize("name", TAUGHT)
def test_a_teacher_typed_on_resume_acts(runs, name):
    other = {"algorithm.teacher_steps": 0, "algorithm.imitation": ((0, 0.5),)}
    changed = {**TAUGHT, name: other.get(name)}
    if changed[name] is None:
        changed = {}
    assert not same(runs["sac"].learned(TAUGHT), runs["sac"].learned(changed))


@pytest.mark.parametrize(("learner", "name"), cases(FIXED), ids=lambda part: part)
def test_a_setting_that_cannot_act_is_an_error(runs, learner, name):
    words = name.replace("algorithm.num_atoms", "critic").split(".")
    with pytest.raises((CheckpointError, UserError), match="|".join(words)):
        runs[learner].resume({name: FIXED[learner][name]})


@pytest.mark.parametrize("learner", CFGS)
def test_every_setting_is_decided(learner):
    kinds = {
        "ppo": RslRlOnPolicyRunnerCfg,
        "sac": RslRlOffPolicyRunnerCfg,
        "distillation": RslRlDistillationRunnerCfg,
    }
    names = set()
    for field in fields(kinds[learner]):
        value = getattr(kinds[learner](), field.name)
        is_part = isinstance(value, RslRlModelCfg) or field.name == "algorithm"
        inner = [f"{field.name}.{one.name}" for one in fields(value)] if is_part else [field.name]
        names |= {
            name
            for name in inner
            if not (isinstance(value, RslRlModelCfg) and name.partition(".")[2] in OF_NETWORKS)
        }
    decided = {*ACTING[learner], *FIXED[learner], *(TAUGHT if learner == "sac" else ())}
    # Parts of dicts: `actor.distribution_cfg.init_std`, `obs_groups.actor`.
    decided |= {name.rpartition(".")[0] for name in decided}
    assert names - decided - OTHERS == set()


# Restored state.


def rates(runner: Any) -> list[float]:
    return [group["lr"] for group in runner.alg.optimizer.param_groups]


def test_an_adapted_rate_is_kept_unless_it_is_typed(runs):
    run = runs["ppo"]
    adapted = rates(run.resume({}))
    assert adapted != [1e-3]
    # The value of the config, as recorded, is no typed one.
    assert rates(run.resume({"algorithm.learning_rate": 5e-4}, typed=False)) == adapted
    typed = run.resume({"algorithm.learning_rate": 5e-4})
    assert rates(typed) == [5e-4]
    assert typed.alg.learning_rate == 5e-4
    typed.learn(3)
    # The adaptive schedule divides and multiplies by 1.5.
    steps = math.log(typed.alg.learning_rate / 5e-4) / math.log(1.5)
    assert steps == pytest.approx(round(steps), abs=1e-6)
    assert rates(typed) == [typed.alg.learning_rate]


def test_a_typed_rate_is_constant_under_a_fixed_schedule(runs):
    runner = runs["ppo"].resume({"algorithm.learning_rate": 1e-5, "algorithm.schedule": "fixed"})
    runner.learn(4)
    assert rates(runner) == [1e-5]


def test_rates_and_seeds_give_other_weights(runs):
    """Two resumes with other rates and seeds once ended with identical weights."""
    for learner, name in (
        ("ppo", "learning_rate"), ("sac", "actor_learning_rate"), ("distillation", "learning_rate"),
    ):  # fmt: skip
        run = runs[learner]
        one, other = (
            run.learned({f"algorithm.{name}": rate, "seed": seed})
            for rate, seed in ((1e-5, 5), (1e-6, 6))
        )
        assert not same(one, other)
        for rate in (1e-5, 1e-6):
            found = run.learned({f"algorithm.{name}": rate})["rates"]
            assert torch.tensor(rate) in found or learner == "ppo"


@pytest.mark.parametrize("learner", CFGS)
def test_a_typed_seed_draws_new_numbers(runs, learner):
    run = runs[learner]
    of_5, again, of_6 = (run.learned({"seed": seed}) for seed in (5, 5, 6))
    assert same(of_5, again)
    assert not same(of_5, of_6)
    # A seed that is not typed, and one that is to be drawn by `train`, draw nothing.
    assert same(run.learned({"seed": 5}, typed=False), run.unchanged)
    assert same(run.learned({"seed": -1}), run.unchanged)


def test_rates_of_sac_are_set_one_by_one(runs):
    runner = runs["sac"].resume({"algorithm.critic_learning_rate": 1e-5})
    assert rates(runner) == [1e-5, 3e-4, 3e-4]
    runner = runs["sac"].resume({"algorithm.alpha_learning_rate": 1e-5})
    assert rates(runner) == [3e-4, 3e-4, 1e-5]
    runner = runs["sac"].resume({"algorithm.weight_decay": 0.5, "algorithm.init_alpha": 0.25})
    groups = runner.alg.optimizer.param_groups
    assert [group["weight_decay"] for group in groups] == [0.5, 0.5, 0.0]
    alpha = runner.alg.save()["sac_state_dict"]["log_alpha"].exp()
    assert float(alpha) == pytest.approx(0.25)


@pytest.mark.parametrize("kind", ["adamw", "sgd", "rmsprop"])
@pytest.mark.parametrize("learner", ["ppo", "distillation"])
def test_another_optimizer_starts_fresh(runs, caplog, learner, kind):
    runner = runs[learner].resume({"algorithm.optimizer": kind})
    assert (
        f"starts fresh, with learning rate 0.001: the checkpoint has the state of adam, this run uses {kind}"
        in caplog.text
    )
    assert len(runner.alg.optimizer.state) == 0
    assert rates(runner) == [1e-3]
    runner.learn(4)


@pytest.mark.parametrize("kind", ["adam", "adamw", "sgd", "rmsprop"])
def test_the_same_optimizer_continues(tmp_path, caplog, kind):
    run = Run("ppo", tmp_path, **{"algorithm.optimizer": kind})
    runner = run.resume({})
    assert "fresh" not in caplog.text
    assert len(runner.alg.optimizer.state) > 0 or kind == "sgd"
    other = "adam" if kind == "sgd" else "sgd"
    run.resume({"algorithm.optimizer": other}).learn(3)
    assert f"state of {kind}, this run uses {other}" in caplog.text


def test_a_standard_deviation_is_set(runs):
    deviation = runs["ppo"].resume({"actor.distribution_cfg.init_std": 0.25}).alg.get_policy()
    assert torch.equal(deviation.distribution.std_param, torch.full((2,), 0.25))


def test_the_rate_of_curiosity_is_set(tmp_path):
    rnd = {
        "num_outputs": 2,
        "predictor_hidden_dims": (4,),
        "target_hidden_dims": (4,),
        "weight": 0.1,
        "learning_rate": 1e-3,
    }
    groups = {"actor": ("actor",), "critic": ("critic",), "rnd_state": ("actor",)}
    run = Run("ppo", tmp_path, **{"algorithm.rnd_cfg": rnd, "obs_groups": groups})
    runner = run.resume({"algorithm.rnd_cfg.learning_rate": 1e-5, "algorithm.rnd_cfg.weight": 0.2})
    assert [group["lr"] for group in runner.alg.rnd.optimizer.param_groups] == [1e-5]
    assert rates(runner) != [1e-5]
    runner.learn(3)
    assert runner.alg.rnd.weight == pytest.approx(0.2 * runner.env.unwrapped.step_dt)
