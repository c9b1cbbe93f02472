"""Kinds of noise."""

from __future__ import annotations

import pytest
import torch

from mjlab.utils.noise import ConstantNoiseCfg, GaussianNoiseCfg, UniformNoiseCfg

DATA = torch.linspace(-2, 2, 30_000).view(10_000, 3)
PER_COMPONENT = (0.5, 1.0, 2.0)


@pytest.mark.parametrize(
    ("operation", "expected"), [("add", DATA + 0.5), ("scale", DATA * 0.5), ("abs", DATA * 0 + 0.5)]
)
def test_constant_noise(operation, expected):
    torch.testing.assert_close(
        ConstantNoiseCfg(bias=0.5, operation=operation).apply(DATA), expected
    )


@pytest.mark.parametrize("operation", ["add", "scale", "abs"])
@pytest.mark.parametrize(
    "cfg", [UniformNoiseCfg(-0.5, 1.5), GaussianNoiseCfg(0.25, 0.5), UniformNoiseCfg(0, 1)]
)
def test_operations_combine_the_same_draws(cfg, operation):
    torch.manual_seed(0)
    cfg.operation = "abs"
    noise = cfg.apply(DATA)
    torch.manual_seed(0)
    cfg.operation = operation
    expected = {"add": DATA + noise, "scale": DATA * noise, "abs": noise}[operation]
    torch.testing.assert_close(cfg.apply(DATA), expected)


def test_uniform_noise_fills_its_range():
    noise = UniformNoiseCfg(n_min=-0.5, n_max=1.5, operation="abs").apply(DATA)
    assert noise.min() >= -0.5
    assert noise.max() < 1.5
    torch.testing.assert_close(noise.mean(), torch.tensor(0.5), atol=0.02, rtol=0)
    torch.testing.assert_close(noise.std(), torch.tensor(2 / 12**0.5), atol=0.02, rtol=0)


def test_gaussian_noise_has_its_mean_and_deviation():
    noise = GaussianNoiseCfg(mean=-1.0, std=0.5, operation="abs").apply(DATA)
    torch.testing.assert_close(noise.mean(), torch.tensor(-1.0), atol=0.02, rtol=0)
    torch.testing.assert_close(noise.std(), torch.tensor(0.5), atol=0.02, rtol=0)


@pytest.mark.parametrize("kind", [tuple, list, torch.tensor])
def test_parameters_can_differ_by_component(kind):
    scale = kind(PER_COMPONENT)
    bias = ConstantNoiseCfg(bias=scale, operation="abs").apply(DATA)
    torch.testing.assert_close(bias[7], torch.tensor(PER_COMPONENT))
    low = kind((-0.5, -1.0, -2.0))
    spread = UniformNoiseCfg(n_min=low, n_max=scale, operation="abs").apply(DATA)
    torch.testing.assert_close(spread.amax(0), torch.tensor(PER_COMPONENT), atol=0.01, rtol=0)
    deviation = GaussianNoiseCfg(std=scale, operation="abs").apply(DATA).std(0)
    torch.testing.assert_close(deviation, torch.tensor(PER_COMPONENT), atol=0.05, rtol=0)


def test_the_data_is_not_changed():
    data = torch.ones(4, 3)
    for cfg in (ConstantNoiseCfg(bias=2.0), UniformNoiseCfg(), GaussianNoiseCfg()):
        for operation in ("add", "scale", "abs"):
            cfg.operation = operation
            assert cfg.apply(data) is not data
    assert (data == 1).all()


@pytest.mark.parametrize("values", [(1.0, 2.0), ((1.0, 1.0, 1.0), (2.0, 2.0, 2.0))])
def test_edited_parameters_count_at_once(values):
    """The defect: parameters were cached inside the config at the first use."""
    first, second = values
    constant = ConstantNoiseCfg(bias=first, operation="abs")
    uniform = UniformNoiseCfg(n_min=0.0, n_max=first, operation="abs")
    gaussian = GaussianNoiseCfg(mean=first, std=1e-6, operation="abs")
    for cfg in (constant, uniform, gaussian):
        cfg.apply(DATA)
    constant.bias = second
    uniform.n_min, uniform.n_max = second, 3.0
    gaussian.mean = second
    assert constant.apply(DATA).min() == 2.0
    assert uniform.apply(DATA).min() >= 2.0
    torch.testing.assert_close(gaussian.apply(DATA).mean(), torch.tensor(2.0))


@pytest.mark.parametrize(
    "make",
    [
        lambda: UniformNoiseCfg(n_min=1.0, n_max=1.0),
        lambda: UniformNoiseCfg(n_min=2.0, n_max=1.0),
        lambda: GaussianNoiseCfg(std=0.0),
        lambda: GaussianNoiseCfg(std=-1.0),
        lambda: ConstantNoiseCfg(operation="mul"),  # ty: ignore[invalid-argument-type]
    ],
)
def test_values_out_of_range_are_refused(make):
    with pytest.raises(ValueError, match="must be|expected"):
        make()


@pytest.mark.parametrize(
    ("cfg", "low", "high"),
    [
        (UniformNoiseCfg(n_min=2, n_max=1), 1.0, 2.0),
        (UniformNoiseCfg(n_min=1, n_max=1), 1.0, 1.0),
        (UniformNoiseCfg(n_min=(2.0, 0.5, 1.0), n_max=(1.0, 0.5, 1)), 0.5, 2.0),
        (GaussianNoiseCfg(std=0, mean=3.0), 3.0, 3.0),
        (GaussianNoiseCfg(std=(0.0, -1.0, 0.0)), -9.0, 9.0),
    ],
)
def test_integers_and_tuples_may_be_reversed_or_zero(cfg, low, high):
    values = cfg.apply(torch.zeros(50, 3))
    assert low <= values.min() <= values.max() <= high


def test_an_operation_that_became_invalid_is_refused():
    cfg = ConstantNoiseCfg()
    cfg.operation = "mul"  # ty: ignore[invalid-assignment]
    with pytest.raises(ValueError, match=r"\['add', 'scale', 'abs'\].*'mul'"):
        cfg.apply(DATA)
