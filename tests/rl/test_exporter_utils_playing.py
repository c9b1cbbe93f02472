"""Inference with exported policies in any number of environments."""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import TensorProto, helper
from rsl_rl.models import RNNModel
from tensordict import TensorDict

from mjlab.rl.exporter_utils import (
    DIGEST_KEY,
    OnnxPolicy,
    OnnxPolicyError,
    _alike,
    attach_metadata_to_onnx,
    export_to_onnx,
    initializers_digest,
    load_onnx_policy,
)

ACTIVATIONS = {
    "elu": torch.nn.ELU(),
    "relu": torch.nn.ReLU(),
    "selu": torch.nn.SELU(),
    "lrelu": torch.nn.LeakyReLU(),
    "tanh": torch.nn.Tanh(),
    "sigmoid": torch.nn.Sigmoid(),
    "softplus": torch.nn.Softplus(),
    "gelu": torch.nn.GELU(),
    "swish": torch.nn.SiLU(),
    "mish": torch.nn.Mish(),
    "identity": torch.nn.Identity(),
}


class Exported(torch.nn.Module):
    """Result of rsl_rl's `as_onnx`: a normalizer and a network."""

    input_names, output_names = ("obs",), ("actions",)

    def __init__(self, activation: torch.nn.Module):
        super().__init__()
        torch.manual_seed(0)
        self.register_buffer("mean", torch.randn(1, 5))
        self.register_buffer("std", torch.rand(1, 5) + 0.5)
        self.net = torch.nn.Sequential(
            torch.nn.Linear(5, 8), activation, torch.nn.Linear(8, 8), activation,
            torch.nn.Linear(8, 3),
        )  # fmt: skip

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return self.net((obs - self.mean) / (self.std + 0.01))

    def get_dummy_inputs(self) -> tuple[torch.Tensor]:
        return (torch.zeros(1, 5),)


def export(path: Path, activation: str = "elu", **metadata: str) -> Path:
    export_to_onnx(Exported(ACTIVATIONS[activation]), path)
    if metadata:
        model = onnx.load(str(path))
        helper.set_model_props(model, metadata)
        onnx.save(model, str(path))
    return path


def as_earlier(path: Path, batch: int | str) -> Path:
    """Write the file as earlier releases did: batch size 1 or dynamic, and no word about the graph."""
    model = onnx.load(str(path))
    for value in (*model.graph.input, *model.graph.output):
        dim = value.type.tensor_type.shape.dim[int(value.name[1:] in ("_in", "_out"))]
        if isinstance(batch, str):
            dim.dim_param = batch
        assert isinstance(batch, str) or dim.dim_value == batch
    del model.metadata_props[:]
    onnx.save(model, str(path))
    return path


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_it_computes_what_torch_does(tmp_path: Path, activation: str) -> None:
    path = export(tmp_path / "policy.onnx", activation)
    rows = 3.0 * torch.randn(6, 5, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        expected = Exported(ACTIVATIONS[activation])(rows)
    policy = OnnxPolicy(path)
    torch.testing.assert_close(policy(rows), expected, rtol=1e-4, atol=1e-5)
    assert (policy.num_observations, policy.num_actions) == (5, 3)
    for batch in (1, "batch"):
        earlier = OnnxPolicy(as_earlier(path, batch))
        torch.testing.assert_close(earlier(rows), expected, rtol=1e-4, atol=1e-5)
        assert (earlier.num_observations, earlier.num_actions) == (5, 3)


@pytest.mark.parametrize("batch", [None, 1, "batch"])
@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("kind", ["lstm", "gru"])
def test_memory_is_per_environment_and_episode(
    tmp_path: Path, kind: str, layers: int, batch: int | str | None
) -> None:
    torch.manual_seed(1)
    observations = TensorDict({"actor": torch.zeros(3, 5)}, batch_size=[3])
    model = RNNModel(
        observations, {"actor": ["actor"]}, "actor", 2, (8,), rnn_type=kind, rnn_hidden_dim=6,
        rnn_num_layers=layers,
    )  # fmt: skip
    export_to_onnx(model.as_onnx(), tmp_path / "p.onnx")
    if batch is not None:
        as_earlier(tmp_path / "p.onnx", batch)
    policy = OnnxPolicy(tmp_path / "p.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "p.onnx"))
    memories = [item.name for item in session.get_inputs()][1:]
    zeros = {name: np.zeros((layers, 1, 6), np.float32) for name in memories}
    remembered = [dict(zeros) for _ in range(3)]
    for step in range(6):
        seen = torch.randn(3, 5)
        actions, own = policy(seen), model(TensorDict({"actor": seen}, batch_size=[3]))
        torch.testing.assert_close(actions, own, rtol=1e-4, atol=1e-5)
        for env in range(3):
            inputs = {"obs": seen[env : env + 1].numpy(), **remembered[env]}
            action, *after = session.run(None, inputs)
            np.testing.assert_allclose(actions[env : env + 1], action, rtol=1e-4, atol=1e-5)
            remembered[env] = dict(zip(memories, after, strict=True))
        dones = torch.tensor([step == 1, False, step == 3]).long()
        for forgets in (policy, model):
            forgets.reset(dones)
        for env in dones.nonzero().flatten().tolist():
            remembered[env] = dict(zeros)
    # Everything is forgotten, and then all are the same, but for rounding.
    differ = policy(torch.ones(3, 5)).std(dim=0)
    policy.reset()
    assert (policy(torch.ones(3, 5)).std(dim=0) < 1e-4 * differ).all()


@pytest.mark.parametrize("has_digest", [True, False])
@pytest.mark.parametrize("edited", [True, False])
def test_weights_that_are_not_those_that_were_exported_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, has_digest: bool, edited: bool
) -> None:
    path = export(tmp_path / "p.onnx")
    if has_digest:
        attach_metadata_to_onnx(str(path), {DIGEST_KEY: initializers_digest(path)})
    if edited:
        weights = onnx.load(str(path)).graph.initializer[0].raw_data
        content = bytearray(path.read_bytes())
        content[content.index(weights)] ^= 1
        path.write_bytes(content)
    OnnxPolicy(path)
    assert ("not those exported" in caplog.text) == (has_digest and edited)


def test_it_takes_the_group_of_observations_that_it_was_trained_with(tmp_path: Path) -> None:
    policy = OnnxPolicy(export(tmp_path / "p.onnx", observation_group="walker"))
    rows = torch.randn(2, 5)
    groups = {"walker": rows, "critic": torch.zeros(2, 9)}
    assert torch.equal(policy(groups), policy(rows))


def test_what_is_no_policy_is_refused_with_the_reason(tmp_path: Path) -> None:
    with pytest.raises(OnnxPolicyError, match="No such file.*nothing.onnx"):
        OnnxPolicy(tmp_path / "nothing.onnx")
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(export(tmp_path / "p.onnx").read_bytes()[:500])
    with pytest.raises(OnnxPolicyError, match="not an ONNX file"):
        OnnxPolicy(broken)
    (tmp_path / "empty.onnx").touch()
    with pytest.raises(OnnxPolicyError, match="not an ONNX file"):
        OnnxPolicy(tmp_path / "empty.onnx")


def graph(
    path: Path, nodes: list, inputs: list[str], outputs: list[str], batch: int | str = 1
) -> Path:
    def values(names: list[str]) -> list:
        return [helper.make_tensor_value_info(n, TensorProto.FLOAT, [batch, 2]) for n in names]

    made = helper.make_graph(nodes, "policy", values(inputs), values(outputs))
    onnx.save(helper.make_model(made), str(path))
    return path


def test_what_onnxruntime_does_not_compute_is_told_in_one_line(tmp_path: Path, capfd) -> None:
    nodes = [helper.make_node("Rumble", ["x"], ["y"])]
    path = graph(tmp_path / "r.onnx", nodes, ["x"], ["y"])
    with pytest.raises(OnnxPolicyError, match=r"r\.onnx.*Rumble.*[Pp]lay the checkpoint") as caught:
        load_onnx_policy(path, SimpleNamespace(unwrapped=SimpleNamespace(num_envs=1)), "cpu")
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_inputs_and_outputs_that_are_not_known_are_named(tmp_path: Path) -> None:
    two = graph(
        tmp_path / "2.onnx", [helper.make_node("Add", ["x", "h"], ["y"])], ["x", "h"], ["y"]
    )
    with pytest.raises(OnnxPolicyError, match=r"got inputs \['x', 'h'\]"):
        OnnxPolicy(two)
    nodes = [helper.make_node("Relu", ["x"], [name]) for name in ("y", "z")]
    several = graph(tmp_path / "s.onnx", nodes, ["x"], ["y", "z"])
    with pytest.raises(OnnxPolicyError, match=r"expected an output 'actions', got .*\['y', 'z'\]"):
        OnnxPolicy(several)
    four = graph(tmp_path / "4.onnx", [helper.make_node("Relu", ["x"], ["y"])], ["x"], ["y"], 4)
    with pytest.raises(OnnxPolicyError, match=r"\['x'\] of sizes \[\[4, 2\]\]"):
        OnnxPolicy(four)


def test_only_what_the_actions_follow_from_is_computed(tmp_path: Path) -> None:
    """Such as in files of motion tracking, which return the reference at another input."""
    nodes = [
        helper.make_node("Exp", ["time_step"], ["frame"]),
        helper.make_node("Relu", ["obs"], ["h"]),
        helper.make_node("Neg", ["frame"], ["joint_pos"]),
        helper.make_node("Tanh", ["h"], ["actions"]),
    ]
    path = graph(tmp_path / "p.onnx", nodes, ["time_step", "obs"], ["joint_pos", "actions"])
    policy = OnnxPolicy(path)
    rows = torch.randn(4, 2)
    torch.testing.assert_close(policy(rows), rows.relu().tanh())
    assert (policy.num_observations, policy.num_actions) == (2, 2)
    mixed = [*nodes[:3], helper.make_node("Add", ["h", "time_step"], ["actions"])]
    path = graph(tmp_path / "m.onnx", mixed, ["time_step", "obs"], ["joint_pos", "actions"])
    with pytest.raises(OnnxPolicyError, match=r"got inputs \['time_step', 'obs'\].*play the che"):
        OnnxPolicy(path)


def test_rounded_numbers_are_alike() -> None:
    assert _alike("0.373,0.249", "0.37275302,0.24850203")
    assert _alike("0.25", "0.25,0.25,0.25")
    assert not _alike("0.25,0.5,0.25", "0.25,0.25,0.25")
    assert not _alike("a,b", "a,c")
    assert not _alike("a,b", "a")


def test_an_environment_with_other_observations_or_actions_is_refused(
    tmp_path: Path, monkeypatch
) -> None:
    path = export(
        tmp_path / "p.onnx", observation_names="speed,angle", step_dt="0.02", action_scale="0.5"
    )
    monkeypatch.setattr(
        "mjlab.rl.exporter_utils.get_base_metadata",
        lambda env, run, groups: {
            "observation_names": ["speed", "height"],
            "step_dt": 0.02,
            "action_scale": 0.25,
        },
    )
    env = SimpleNamespace(
        num_envs=2,
        action_manager=SimpleNamespace(total_action_dim=4),
        observation_manager=SimpleNamespace(group_obs_dim={}),
    )
    with pytest.raises(OnnxPolicyError) as caught:
        load_onnx_policy(path, SimpleNamespace(unwrapped=env), "cpu")
    message = str(caught.value)
    assert "observation_names: the policy has speed,angle, the environment speed,height" in message
    assert "action_scale: the policy has 0.5, the environment 0.25" in message
    assert "actions: the policy has 3, not 4" in message
    assert "step_dt" not in message


@pytest.fixture
def endless_policy(tmp_path: Path) -> OnnxPolicy:
    """Return a policy that loops for ever if its observations are not zero."""
    types = {"i": TensorProto.INT64, "go": TensorProto.BOOL, "x": TensorProto.FLOAT}
    kinds = {"i": [], "go": [], "x": [None, 1]}
    values = {name: helper.make_tensor_value_info(name, types[name], kinds[name]) for name in types}
    outputs = [
        helper.make_tensor_value_info("go_out", TensorProto.BOOL, []),
        helper.make_tensor_value_info("x_out", TensorProto.FLOAT, [None, 1]),
    ]
    nodes = [
        helper.make_node("Identity", ["go"], ["go_out"]),
        helper.make_node("Identity", ["x"], ["x_out"]),
    ]
    body = helper.make_graph(nodes, "body", list(values.values()), outputs)
    zero = helper.make_tensor("zero", TensorProto.FLOAT, [], [0.0])
    nodes = [
        helper.make_node("ReduceMax", ["obs"], ["most"], keepdims=0),
        helper.make_node("Greater", ["most", "zero"], ["begin"]),
        helper.make_node("Loop", ["", "begin", "obs"], ["actions"], body=body),
    ]
    inputs = [helper.make_tensor_value_info("obs", TensorProto.FLOAT, ["n", 1])]
    results = [helper.make_tensor_value_info("actions", TensorProto.FLOAT, ["n", 1])]
    whole = helper.make_graph(nodes, "policy", inputs, results, [zero])
    opset = [helper.make_opsetid("", 18)]
    onnx.save(helper.make_model(whole, opset_imports=opset, ir_version=8), tmp_path / "loop.onnx")
    return OnnxPolicy(tmp_path / "loop.onnx")


def test_an_endless_loop_ends_at_ctrl_c(endless_policy) -> None:
    before = threading.enumerate()
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        interrupt = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT))
        interrupt.start()
        with pytest.raises(KeyboardInterrupt):
            endless_policy(torch.ones(2, 1))
        interrupt.join()
    finally:
        signal.signal(signal.SIGINT, previous)
    assert threading.enumerate() == before
    assert endless_policy(torch.zeros(2, 1)).tolist() == [[0.0], [0.0]]


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGUSR1")
def test_other_signals_end_no_call(endless_policy) -> None:
    numbers = []
    previous = signal.signal(signal.SIGUSR1, lambda number, _: numbers.append(number))
    interrupted = signal.signal(signal.SIGINT, signal.default_int_handler)
    timers = [
        threading.Timer(seconds, os.kill, (os.getpid(), number))
        for seconds, number in ((0.2, signal.SIGUSR1), (0.5, signal.SIGINT))
    ]
    try:
        for timer in timers:
            timer.start()
        with pytest.raises(KeyboardInterrupt):
            endless_policy(torch.ones(2, 1))
    finally:
        for timer in timers:
            timer.join()
        signal.signal(signal.SIGUSR1, previous)
        signal.signal(signal.SIGINT, interrupted)
    assert numbers == [signal.SIGUSR1]


def test_a_policy_has_no_thread(tmp_path: Path) -> None:
    before = threading.enumerate()
    policy = OnnxPolicy(export(tmp_path / "policy.onnx"))
    policy(torch.zeros(2, 5))
    assert threading.enumerate() == before
