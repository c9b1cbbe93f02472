"""Image encoders."""

from __future__ import annotations

import numpy as np
import onnxruntime
import pytest
import torch
from tensordict import TensorDict

from mjlab.rl.exporter_utils import export_to_onnx
from mjlab.rl.spatial_softmax import SpatialSoftmax, SpatialSoftmaxCNN, SpatialSoftmaxCNNModel

CNN_CFG = {
    "output_channels": (4, 6),
    "kernel_size": (5, 3),
    "stride": (2, 2),
    "padding": "zeros",
    "spatial_softmax": True,
    "spatial_softmax_temperature": 0.5,
}


def test_a_sharp_peak_is_found_row_first():
    features = torch.full((1, 2, 3, 5), -100.0)
    features[0, 0, 2, 1] = 100.0
    features[0, 1, 0, 4] = 100.0
    assert torch.allclose(SpatialSoftmax(3, 5)(features), torch.tensor([[1.0, -0.5, -1.0, 1.0]]))


def test_temperature_flattens_and_a_side_of_one_is_at_minus_one():
    features = torch.randn(2, 3, 1, 4)
    flat = SpatialSoftmax(1, 4, temperature=1e6)(features)
    expected = torch.tensor([-1.0, 0.0]).repeat(2, 3)
    assert torch.allclose(flat, expected, atol=1e-4)


def test_the_formula():
    features, softmax = torch.randn(2, 3, 4, 5), SpatialSoftmax(4, 5, temperature=0.7)
    weights = torch.exp(features / 0.7)
    weights = weights / weights.sum((-1, -2), keepdim=True)
    rows, columns = torch.linspace(-1, 1, 4)[:, None], torch.linspace(-1, 1, 5)
    expected = torch.stack(
        ((weights * rows).sum((-1, -2)), (weights * columns).sum((-1, -2))), dim=-1
    )
    assert torch.allclose(softmax(features), expected.flatten(1), atol=1e-6)
    assert set(softmax.state_dict()) == {"rows", "columns"}


def images() -> TensorDict:
    return TensorDict(
        {"state": torch.randn(3, 7), "camera": torch.rand(3, 2, 32, 32)}, batch_size=[3]
    )


def model(cnn_cfg=CNN_CFG, **kwargs) -> SpatialSoftmaxCNNModel:
    groups = {"actor": ["state", "camera"]}
    return SpatialSoftmaxCNNModel(images(), groups, "actor", 4, cnn_cfg, **kwargs)


def test_the_encoder_has_two_outputs_a_channel():
    encoder = SpatialSoftmaxCNN((32, 32), 2, output_channels=(4, 6), kernel_size=3, stride=2)
    assert encoder.output_dim == 12
    assert encoder.output_channels is None
    assert encoder(torch.rand(3, 2, 32, 32)).shape == (3, 12)


def test_the_model_joins_images_and_state_and_exports(tmp_path):
    network = model(hidden_dims=[16])
    assert network.cnns["camera"].spatial_softmax.temperature == 0.5
    observations = images()
    expected = network(observations).detach().numpy()
    assert expected.shape == (3, 4)
    export_to_onnx(network.as_onnx(verbose=False), tmp_path / "policy.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"))
    assert [entry.name for entry in session.get_inputs()] == ["obs", "camera"]
    for row in range(3):
        given = {
            "obs": observations["state"][row : row + 1].numpy(),
            "camera": observations["camera"][row : row + 1].numpy(),
        }
        (actual,) = session.run(None, given)
        np.testing.assert_allclose(actual, expected[row : row + 1], atol=1e-5)


def test_encoders_are_shared_or_configured_by_name():
    first = model({"camera": CNN_CFG})
    second = model(cnns=first.cnns)
    assert second.cnns["camera"] is first.cnns["camera"]
    with pytest.raises(ValueError, match=r"\['camera'\].*got configs for \['other'\]"):
        model({"other": CNN_CFG})
    with pytest.raises(ValueError, match="2D observations"):
        model(cnns=torch.nn.ModuleDict({"other": first.cnns["camera"]}))
