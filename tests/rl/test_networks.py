"""Checks of networks and mini-batches before training."""

from __future__ import annotations

from dataclasses import asdict

import pytest
from rsl_rl.models import MLPModel
from rsl_rl.modules import GaussianDistribution

from mjlab.rl.config import RslRlModelCfg, RslRlPpoAlgorithmCfg, gaussian_distribution

RECURRENT = asdict(
    RslRlModelCfg(class_name="RNNModel", hidden_dims=(8,), rnn_type="gru", rnn_hidden_dim=8)
)


def algorithm(parts: int) -> dict:
    return asdict(RslRlPpoAlgorithmCfg(num_mini_batches=parts))


@pytest.mark.parametrize(
    ("networks", "most"), [({}, 8 * 5), ({"critic": RECURRENT}, 8)], ids=["plain", "recurrent"]
)
def test_more_mini_batches_than_data_warn(make_runner, networks, most, recwarn):
    make_runner(num_envs=8, algorithm=algorithm(most), **networks).learn(1)
    assert not [one for one in recwarn if "num_mini_batches" in str(one.message)]
    with pytest.warns(UserWarning, match=rf"num_mini_batches.*at most {most}.*got {most + 1}"):
        runner = make_runner(num_envs=8, algorithm=algorithm(most + 1), **networks)
        runner.learn(1)
    assert runner.current_learning_iteration == 1


def test_a_runner_without_folder_needs_no_save_interval(make_runner):
    runner = make_runner(num_envs=2, algorithm=algorithm(1))
    del runner.cfg["save_interval"]
    runner.learn(2)
    assert runner.current_learning_iteration == 2


def test_a_runner_that_only_acts_takes_any_number_of_environments(make_runner):
    make_runner(num_envs=1, algorithm=algorithm(4), critic=RECURRENT)


@pytest.mark.parametrize(
    ("networks", "cure"),
    [
        ({}, r"gaussian_distribution\(\)"),
        ({"class_name": "mjlab.rl.sac_models:SacActorModel"}, r"squashed_gaussian\(\)"),
    ],
)
def test_an_actor_without_distribution_is_refused_when_built(make_runner, networks, cure):
    actor = asdict(RslRlModelCfg(hidden_dims=(8,), **networks))
    with pytest.raises(ValueError, match=rf"agent.actor distribution_cfg: .*None; use.*{cure}"):
        make_runner(actor=actor)


class NeedsValues(GaussianDistribution):
    """Distribution of a package, which reads numbers of tensors when built."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.least = float(self.std_param.min())


def test_a_distribution_of_a_package_may_read_its_values(make_runner):
    cfg = {"class_name": f"{__name__}:NeedsValues", "init_std": 0.5, "std_type": "scalar"}
    actor = asdict(RslRlModelCfg(hidden_dims=(8,), distribution_cfg=cfg))
    assert make_runner(actor=actor).alg.actor.distribution.least == 0.5


class OwnNoise(MLPModel):
    """Actor of a package, with a distribution that its config does not mention."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, distribution_cfg=gaussian_distribution(), **kwargs)


def test_an_actor_of_a_package_may_bring_its_own_distribution(make_runner):
    actor = asdict(RslRlModelCfg(hidden_dims=(8,), class_name=f"{__name__}:OwnNoise"))
    make_runner(actor=actor)
