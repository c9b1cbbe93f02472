"""Exported policies in deployment programs: fixed sizes in the file, any batch size in ours."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from rsl_rl.models import CNNModel, MLPModel, RNNModel
from tensordict import TensorDict

from mjlab.rl.config import gaussian_distribution, squashed_gaussian
from mjlab.rl.exporter_utils import (
    DIGEST_KEY,
    OnnxPolicy,
    attach_metadata_to_onnx,
    export_to_onnx,
    initializers_digest,
)
from mjlab.rl.sac_models import SacActorModel
from mjlab.rl.spatial_softmax import SpatialSoftmaxCNNModel
from mjlab.scripts.demo import DEMOS
from mjlab.tasks.tracking.rl.runner import REFERENCE, PolicyWithReference

N, ACTIONS = 5, 3
CNN_CFG = {"output_channels": (4, 6), "kernel_size": (5, 3), "stride": (2, 2), "padding": "zeros"}


def observations() -> TensorDict:
    generator = torch.Generator().manual_seed(1)
    shapes = {"state": (7,), "camera": (2, 16, 16), "depth": (1, 12, 12)}
    groups = {name: torch.rand(N, *shape, generator=generator) for name, shape in shapes.items()}
    return TensorDict(groups, batch_size=[N])


def network(kind: type, *groups: str, **settings: Any) -> Any:
    """Return a network with a normalizer that has seen data."""
    torch.manual_seed(0)
    settings = {"distribution_cfg": gaussian_distribution(), **settings}
    if "obs_normalization" not in settings and "state" in groups:
        settings["obs_normalization"] = True
    shown = observations()
    model = kind(
        shown,
        {"actor": list(groups)},
        "actor",
        ACTIONS,
        hidden_dims=(8,),
        activation="elu",
        **settings,
    )
    model.update_normalization(shown)
    return model


BOUNDS = [0.5 + i for i in range(ACTIONS)]


def with_reference(model: Any) -> Any:
    """Return the export of a motion tracking policy: the reference of 4 frames and 2 bodies."""
    sizes = {"joint_pos": (6,), "joint_vel": (6,), "body_quat_w": (2, 4)}
    motion = {name: torch.rand(4, *sizes.get(name, (2, 3))) for name in REFERENCE}
    return PolicyWithReference(
        model.as_onnx(verbose=False), SimpleNamespace(**motion, time_step_total=4)
    )


MODELS = {
    "mlp": lambda: network(MLPModel, "state"),
    "no_normalizer": lambda: network(MLPModel, "state", obs_normalization=False),
    "student": lambda: network(MLPModel, "state", distribution_cfg=gaussian_distribution(0.1)),
    "lstm": lambda: network(RNNModel, "state", rnn_type="lstm", rnn_hidden_dim=6, rnn_num_layers=2),
    "gru": lambda: network(RNNModel, "state", rnn_type="gru", rnn_hidden_dim=6),
    "cnn": lambda: network(CNNModel, "state", "camera", cnn_cfg=CNN_CFG),
    "images_only": lambda: network(SpatialSoftmaxCNNModel, "camera", "depth", cnn_cfg=CNN_CFG),
    "spatial_softmax": lambda: network(SpatialSoftmaxCNNModel, "state", "camera", cnn_cfg=CNN_CFG),
    "sac": lambda: network(SacActorModel, "state", distribution_cfg=squashed_gaussian()),
    "sac_with_bounds": lambda: network(
        SacActorModel, "state", distribution_cfg=squashed_gaussian() | {"bounds": BOUNDS}
    ),
    "tracking": lambda: network(MLPModel, "state"),
}


@pytest.fixture(params=MODELS)
def exported(request, tmp_path: Path) -> tuple[Any, Path]:
    """Return a network and its file."""
    model, path = MODELS[request.param](), tmp_path / "policy.onnx"
    export_to_onnx(
        with_reference(model) if request.param == "tracking" else model.as_onnx(verbose=False), path
    )
    attach_metadata_to_onnx(str(path), {DIGEST_KEY: initializers_digest(path)})
    return model, path


class Program:
    """Deployment program: buffers of the sizes that the file declares, for one robot."""

    def __init__(self, path: Path) -> None:
        self.session = onnxruntime.InferenceSession(str(path))
        values = (*self.session.get_inputs(), *self.session.get_outputs())
        self.shapes = {value.name: value.shape for value in values}
        # Symbols are strings here, and -1 in C++.
        self.sizes = {name: math.prod(map(int, shape)) for name, shape in self.shapes.items()}
        inputs = [value.name for value in self.session.get_inputs()]
        self.buffers = {name: np.zeros(self.sizes[name], np.float32) for name in inputs}

    def run(self, **values: np.ndarray) -> np.ndarray:
        """Fill the buffers with `values`; return the actions and keep the hidden state."""
        for name, value in values.items():
            self.buffers[name][:] = value.ravel()
        feed = {name: value.reshape(self.shapes[name]) for name, value in self.buffers.items()}
        names = [value.name for value in self.session.get_outputs()]
        results = dict(zip(names, self.session.run(None, feed), strict=True))
        assert {name: value.size for name, value in results.items()} == {
            name: self.sizes[name] for name in names
        }
        for name in ("h", "c"):
            if f"{name}_in" in self.buffers:
                self.buffers[f"{name}_in"][:] = results[f"{name}_out"].ravel()
        return results["actions"]


def test_a_program_and_a_batch_compute_the_policy(exported):
    model, path = exported
    shown = observations()
    policy, programs = OnnxPolicy(path), [Program(path) for _ in range(N)]
    model.eval()
    flat = "state" if "obs" in programs[0].shapes else None
    inputs = {name: shown[name] for name in ("camera", "depth") if name in programs[0].shapes}
    assert programs[0].sizes["actions"] == ACTIONS
    assert all(1 in shape for shape in programs[0].shapes.values())
    for _ in range(3):
        with torch.inference_mode():
            expected = model(shown)
        actions = policy({**inputs, "actor": shown["state"]})
        torch.testing.assert_close(actions, expected, rtol=1e-4, atol=1e-5)
        for row, program in enumerate(programs):
            values = {name: value[row].numpy() for name, value in inputs.items()}
            if flat:
                values["obs"] = shown["state"][row].numpy()
            np.testing.assert_allclose(
                program.run(**values)[0], expected[row].numpy(), rtol=1e-4, atol=1e-5
            )


def test_the_identity_of_the_weights_holds(exported, caplog):
    _, path = exported
    OnnxPolicy(path)
    assert not caplog.records


@pytest.mark.parametrize("name", sorted(DEMOS))
def test_shipped_policies_run_in_programs(name):
    path = DEMOS[name].policy
    program, policy = Program(path), OnnxPolicy(path)
    rows = torch.rand(4, policy.num_observations)
    actions = policy(rows)
    for row in range(4):
        np.testing.assert_allclose(
            program.run(obs=rows[row].numpy())[0], actions[row].numpy(), rtol=1e-4, atol=1e-5
        )
    assert "graph_batch_size" in {entry.key for entry in onnx.load(path).metadata_props}
