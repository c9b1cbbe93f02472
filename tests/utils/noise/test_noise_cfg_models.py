"""Noise models and their biases."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch

from mjlab.utils.noise import (
    ConstantNoiseCfg,
    NoiseModel,
    NoiseModelCfg,
    NoiseModelWithAdditiveBias,
    NoiseModelWithAdditiveBiasCfg,
    UniformNoiseCfg,
)
from mjlab.utils.state import capture_state, restore_state

NO_NOISE = ConstantNoiseCfg(bias=0.0)
DATA = torch.zeros(5, 3)


def _bias_model(per_component: bool = True, bias=None) -> NoiseModelWithAdditiveBias:
    cfg = NoiseModelWithAdditiveBiasCfg(
        noise_cfg=NO_NOISE,
        bias_noise_cfg=bias or UniformNoiseCfg(n_min=1.0, n_max=2.0),
        sample_bias_per_component=per_component,
    )
    return cfg.class_type(cfg, 5, "cpu")  # ty: ignore[invalid-return-type]


def test_a_model_applies_its_noise():
    cfg = NoiseModelCfg(noise_cfg=ConstantNoiseCfg(bias=0.5))
    model = cfg.class_type(cfg, 5, "cpu")
    model.reset(torch.tensor([0]))
    assert (model(DATA) == 0.5).all()


def test_a_config_names_its_model_by_a_class_keyword():
    class Doubling(NoiseModel):
        def __call__(self, data):
            return 2 * super().__call__(data)

    @dataclass(kw_only=True)
    class DoublingCfg(NoiseModelCfg, class_type=Doubling):
        extra: int

    @dataclass(kw_only=True)
    class DerivedCfg(DoublingCfg):
        pass

    assert DoublingCfg.class_type is DerivedCfg.class_type is Doubling
    assert NoiseModelCfg.class_type is NoiseModel
    cfg = DerivedCfg(noise_cfg=ConstantNoiseCfg(bias=1.0), extra=3)
    assert (cfg.class_type(cfg, 5, "cpu")(DATA) == 2).all()


def test_a_bias_is_kept_between_resets():
    model = _bias_model()
    first = model(DATA)
    assert torch.equal(model(DATA), first)
    assert first.min() >= 1.0
    assert len(first.unique()) == DATA.numel()
    model.reset(torch.tensor([1, 3]))
    second = model(DATA)
    same = (first == second).all(dim=1)
    assert same.tolist() == [True, False, True, False, True]


@pytest.mark.parametrize("per_component", [True, False])
def test_a_bias_does_not_wander(per_component):
    """The defect: each reset added the new bias to the old one."""
    model = _bias_model(per_component, ConstantNoiseCfg(bias=0.1))
    model(DATA)
    for ids in (None, slice(None), torch.arange(5), None):
        model.reset(ids)
        torch.testing.assert_close(model(DATA), torch.full_like(DATA, 0.1))


def test_one_bias_for_all_components_starts_at_the_first_reset():
    model = _bias_model(per_component=False)
    assert (model(DATA) == 0).all()
    model.reset(torch.tensor([2]))
    biased = model(DATA)
    assert (biased[2] == biased[2, 0]).all()
    assert biased[2, 0] >= 1.0
    assert (biased[[0, 1, 3, 4]] == 0).all()


def test_a_bias_may_differ_by_component():
    model = _bias_model(bias=ConstantNoiseCfg(bias=(1.0, 2.0, 3.0)))
    model.reset()
    assert model(DATA)[4].tolist() == [1.0, 2.0, 3.0]


def test_more_axes_share_the_bias_of_their_component():
    model = _bias_model()
    biased = model(torch.zeros(5, 4, 3))
    assert biased.shape == (5, 4, 3)
    assert (biased == biased[:, :1]).all()
    assert len(biased.unique()) == 15


def test_a_restored_model_has_the_bias_of_the_saved_one():
    saved, other = _bias_model(), _bias_model()
    expected = saved(DATA)
    restore_state(other, capture_state(saved))
    assert torch.equal(other(DATA), expected)


def test_missing_configs_are_refused():
    with pytest.raises(ValueError, match=r"noise_cfg: expected a NoiseCfg, got None"):
        NoiseModel(NoiseModelCfg(noise_cfg=None), 5, "cpu")  # ty: ignore[invalid-argument-type]
    cfg = NoiseModelWithAdditiveBiasCfg(noise_cfg=NO_NOISE)
    with pytest.raises(ValueError, match=r"bias_noise_cfg: expected a NoiseCfg, got None"):
        cfg.class_type(cfg, 5, "cpu")


def test_resets_follow_data_of_inference_mode() -> None:
    noise = UniformNoiseCfg(n_min=1.0, n_max=2.0)
    model = NoiseModelWithAdditiveBiasCfg(noise_cfg=noise, bias_noise_cfg=noise)
    built = NoiseModelWithAdditiveBias(model, num_envs=2, device="cpu")
    with torch.inference_mode():
        built(torch.zeros(2, 3))
    built.reset(torch.tensor([0]))
    assert built(torch.zeros(2, 3)).shape == (2, 3)
