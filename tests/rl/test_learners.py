"""A config of one learner from a config of the other."""

from __future__ import annotations

from dataclasses import asdict, fields, replace
from typing import Any

import pytest

from mjlab.rl.config import (
    EvaluationCfg,
    RslRlBaseRunnerCfg,
    RslRlModelCfg,
    RslRlOffPolicyRunnerCfg,
    RslRlOnPolicyRunnerCfg,
    RslRlSacAlgorithmCfg,
)
from mjlab.rl.learners import acting_cfg, learner_of, train_dict, with_learner

MIRROR = "mjlab.tasks.velocity.symmetry:mirror_left_right"


def ppo() -> RslRlOnPolicyRunnerCfg:
    """Return a config with non-default values in all fields of the base."""
    cfg = RslRlOnPolicyRunnerCfg(evaluation=EvaluationCfg(num_episodes=7))
    for field in fields(RslRlBaseRunnerCfg):
        value = getattr(cfg, field.name)
        if isinstance(value, bool):
            setattr(cfg, field.name, not value)
        elif isinstance(value, (int, str)):
            setattr(cfg, field.name, value * 2 or "x")
    return replace(cfg, clip_actions=3.0, wandb_tags=("a",), obs_groups={"actor": ("a", "b")})


def base_of(cfg: RslRlBaseRunnerCfg) -> dict[str, Any]:
    return {field.name: getattr(cfg, field.name) for field in fields(RslRlBaseRunnerCfg)}


def test_the_fields_of_the_run_survive_both_ways():
    cfg = ppo()
    sac = with_learner(cfg, "sac")
    assert isinstance(sac, RslRlOffPolicyRunnerCfg)
    assert (learner_of(cfg), learner_of(sac)) == ("ppo", "sac")
    assert base_of(sac) == base_of(cfg) == base_of(with_learner(sac, "ppo"))
    assert sac.algorithm == RslRlSacAlgorithmCfg(action_bounds="joint_ranges")
    sac.evaluation.num_episodes = 8
    assert cfg.evaluation.num_episodes == 7


def test_a_config_of_the_learner_is_unchanged():
    for cfg in (RslRlOnPolicyRunnerCfg(), RslRlOffPolicyRunnerCfg(), RslRlBaseRunnerCfg()):
        assert with_learner(cfg, learner_of(cfg)) is cfg


def test_mirror_images_are_made_by_the_same_function():
    cfg = RslRlOnPolicyRunnerCfg()
    cfg.algorithm.symmetry_cfg = {"data_augmentation_func": MIRROR, "use_mirror_loss": True}
    sac: Any = with_learner(cfg, "sac")
    assert sac.algorithm.symmetry_cfg == {"data_augmentation_func": MIRROR}
    back: Any = with_learner(sac, "ppo")
    used = {"data_augmentation_func": MIRROR, "use_data_augmentation": True}
    assert back.algorithm.symmetry_cfg == used


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (RslRlModelCfg(class_name="RNNModel", rnn_type="lstm"), "a recurrent one"),
        (RslRlModelCfg(class_name="CNNModel", cnn_cfg={"stride": [1]}), "one that sees images"),
    ],
)
def test_recurrent_networks_and_those_of_images_have_no_config_of_sac(model, message):
    with pytest.raises(ValueError, match=f"agent.critic: expected .* {message}.*--learner ppo"):
        with_learner(RslRlOnPolicyRunnerCfg(critic=model), "sac")


def test_to_act_takes_the_least_replay():
    cfg = RslRlOffPolicyRunnerCfg()
    acting = acting_cfg(cfg)
    assert acting.pop("algorithm") == {**train_dict(cfg)["algorithm"], "replay_steps": 1}
    assert acting == {key: value for key, value in train_dict(cfg).items() if key != "algorithm"}
    cfg = RslRlOnPolicyRunnerCfg(save_git_diff=False)
    assert acting_cfg(cfg) == train_dict(cfg)


def test_additions_are_passed_if_changed():
    cfg = RslRlOnPolicyRunnerCfg()
    added = {"torch_compile_mode", "save_git_diff", "upload_git_diff", "evaluation", "annealing"}
    assert set(asdict(cfg)) - set(train_dict(cfg)) == added
    of_algorithm = set(asdict(cfg)["algorithm"]) - set(train_dict(cfg)["algorithm"])
    assert of_algorithm == {"symmetry_cfg", "use_mixed_precision"}
    cfg.evaluation.solved_return, cfg.algorithm.use_mixed_precision = 900.0, True
    made = train_dict(cfg)
    assert made["evaluation"]["solved_return"] == 900.0
    assert made["algorithm"]["use_mixed_precision"] is True
    assert "symmetry_cfg" not in made["algorithm"]
