"""Networks of SAC: actions and their probabilities, and distributions of returns."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform

from mjlab.rl.config import gaussian_distribution
from mjlab.rl.sac_models import SacActorModel, SquashedGaussian, TwinCriticModel


def test_squashed_log_probabilities_are_those_of_a_transformed_normal():
    torch.manual_seed(0)
    ours = SquashedGaussian(3, init_std=0.5)
    ours.update(torch.randn(10, 6))
    noise = torch.randn(10, 3)
    actions, log_prob = ours.share_and_log_prob(noise)
    u = Normal(ours.params[0], ours.params[1])
    theirs = TransformedDistribution(u, [TanhTransform(cache_size=1)])
    torch.testing.assert_close(log_prob, theirs.log_prob(actions).sum(-1), atol=1e-3, rtol=1e-4)
    torch.testing.assert_close(ours.entropy, u.entropy().sum(-1))


@pytest.mark.parametrize("bounds", [[1.0], [1.0, 0.0], [1.0, -2.0], [1.0, float("inf")]])
def test_bounds_are_one_positive_number_per_action(bounds):
    with pytest.raises(ValueError, match="expected 2 positive numbers"):
        SquashedGaussian(2, bounds=bounds)


def test_a_deviation_out_of_range_is_refused():
    with pytest.raises(ValueError, match="init_std"):
        SquashedGaussian(2, init_std=2.0)


@pytest.mark.parametrize("distribution", [None, gaussian_distribution()])
def test_another_distribution_than_a_squashed_one_is_refused(distribution):
    observations = TensorDict({"actor": torch.zeros(2, 4)}, batch_size=[2])
    with pytest.raises(ValueError, match="expected a SquashedGaussian"):
        SacActorModel(
            observations,
            {"actor": ["actor"]},
            "actor",
            3,
            hidden_dims=(8,),
            activation="relu",
            distribution_cfg=distribution,
        )


def critic(**changes: Any) -> TwinCriticModel:
    kwargs = {"num_atoms": 101, "value_range": (-5.0, 15.0), "hidden_dims": (8,), **changes}
    observations = TensorDict({"critic": torch.zeros(2, 4)}, batch_size=[2])
    groups = {"critic": ["critic"]}
    return TwinCriticModel(observations, groups, "critic", 3, activation="relu", **kwargs)


def test_distributions_of_returns_have_them_as_mean():
    model = critic()
    returns = torch.linspace(-4.5, 14.5, 57)
    probabilities = model.distribution_of(returns)
    torch.testing.assert_close(probabilities.sum(-1), torch.ones(57))
    torch.testing.assert_close(probabilities @ model.atoms, returns, atol=1e-3, rtol=0.0)


def test_returns_beyond_the_range_count_as_its_ends():
    model = critic()
    far, end = (model.distribution_of(torch.tensor([value])) for value in (99.0, 15.0))
    assert torch.equal(far, end)


@pytest.mark.parametrize("value_range", [(1.0, 1.0), (5.0, -5.0)])
def test_an_empty_range_of_values_raises(value_range):
    with pytest.raises(ValueError, match="value_range: expected low < high"):
        critic(value_range=value_range)


def test_values_keep_their_digits_in_mixed_precision():
    torch.manual_seed(0)
    model = critic()
    with torch.autocast("cpu", torch.bfloat16):
        logits = model.logits(torch.randn(50, 4), torch.zeros(50, 3))
        values = model.values(torch.randn(50, 4), torch.zeros(50, 3))
    assert logits[0].dtype == values.dtype == torch.float32
    # A number of bfloat16 has 8 bits.
    assert not torch.equal(values, values.bfloat16().float())
