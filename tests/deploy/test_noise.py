"""Noise of a contract is that of the training environment."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from mjlab.deploy.noise import Noise, unknown_noises
from mjlab.utils.noise import (
    ConstantNoiseCfg,
    GaussianNoiseCfg,
    NoiseCfg,
    NoiseModelCfg,
    NoiseModelWithAdditiveBiasCfg,
    UniformNoiseCfg,
)
from mjlab.utils.tables import json_value

EXACT = np.array([2.0, -3.0])
COUNT = 4000


@dataclasses.dataclass
class SawtoothNoiseCfg(UniformNoiseCfg):
    pass


def samples(noise, level: float) -> np.ndarray:
    made = Noise(json_value(noise), level, np.random.default_rng(0))
    return np.stack([made(EXACT) for _ in range(COUNT)])


@pytest.mark.parametrize("operation", ["add", "scale", "abs"])
@pytest.mark.parametrize(
    "make",
    [
        lambda operation: ConstantNoiseCfg(bias=(0.5, 0.2), operation=operation),
        lambda operation: UniformNoiseCfg(n_min=-0.2, n_max=(0.4, 0.1), operation=operation),
        lambda operation: GaussianNoiseCfg(mean=0.3, std=(0.1, 0.2), operation=operation),
    ],
)
def test_samples_are_distributed_as_in_training(make, operation: str) -> None:
    cfg: NoiseCfg = make(operation)
    trained = cfg.apply(torch.tensor(EXACT).expand(COUNT, -1)).numpy()
    once, twice = samples(cfg, 1.0), samples(cfg, 2.0)
    tolerance = 5.0 * trained.std(axis=0) / np.sqrt(COUNT) + 1e-6
    assert (np.abs(once.mean(axis=0) - trained.mean(axis=0)) < 1.5 * tolerance).all()
    assert once.std(axis=0) == pytest.approx(trained.std(axis=0), rel=0.1, abs=1e-6)
    assert twice - EXACT == pytest.approx(2.0 * (once - EXACT))
    assert (samples(cfg, 0.0) == EXACT).all()


def test_models_draw_their_bias_once_an_episode() -> None:
    noise = ConstantNoiseCfg(bias=0.5)
    assert samples(NoiseModelCfg(noise_cfg=noise), 1.0) == pytest.approx(
        np.tile(EXACT + 0.5, (COUNT, 1))
    )
    for per_component in (True, False):
        model = NoiseModelWithAdditiveBiasCfg(
            noise_cfg=noise,
            bias_noise_cfg=UniformNoiseCfg(n_min=1.0, n_max=2.0),
            sample_bias_per_component=per_component,
        )
        values = samples(model, 1.0) - EXACT - 0.5
        assert np.ptp(values, axis=0) == pytest.approx(0.0)
        assert ((values > 1.0) & (values < 2.0)).all()
        assert (np.ptp(values, axis=1) > 0.01).all() == per_component


def test_unknown_classes_are_named_and_left_out() -> None:
    own = SawtoothNoiseCfg(n_min=-1.0, n_max=1.0)
    inner = NoiseModelCfg(noise_cfg=own)
    noises = {"a": own, "b": inner, "c": UniformNoiseCfg(n_min=0.0, n_max=1.0), "d": None}
    terms = [{"name": name, "noise": json_value(noise)} for name, noise in noises.items()]
    lines = unknown_noises({"observations": [{"terms": terms}]})
    assert [line[:10] for line in lines] == ["noise of a", "noise of b"]
    assert (samples(own, 1.0) == EXACT).all()
    assert (samples(inner, 1.0) == EXACT).all()
