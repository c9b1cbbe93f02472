"""A policy explores freely, and acts and is exported within bounds."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from mjlab.rl.config import RslRlModelCfg, bounded_gaussian, gaussian_distribution
from mjlab.rl.exporter_utils import action_limit

BOUND = 1e-3


def test_only_the_policy_that_acts_is_bounded(make_runner, tmp_path: Path):
    rows = torch.randn(1, 2, generator=torch.Generator().manual_seed(0))
    policies, acted = [], []
    for cfg in (gaussian_distribution(0.5), bounded_gaussian(BOUND, 0.5)):
        torch.manual_seed(0)
        actor = asdict(RslRlModelCfg(hidden_dims=(8,), distribution_cfg=cfg))
        runner = make_runner(actor=actor)
        runner.learn(2)
        policies.append(runner.alg.get_policy().state_dict())
        with torch.no_grad():
            acted.append(runner.get_inference_policy()({"actor": rows}).numpy())
    free, bounded = policies
    assert free.keys() == bounded.keys()
    assert all(torch.equal(free[name], bounded[name]) for name in free)
    np.testing.assert_array_equal(acted[1], acted[0].clip(-BOUND, BOUND))
    assert np.abs(acted[0]).max() > BOUND
    path = tmp_path / "policy.onnx"
    runner.export_policy_to_onnx(str(tmp_path), path.name)
    assert action_limit(path) == pytest.approx(BOUND)
    (actions,) = onnxruntime.InferenceSession(str(path)).run(None, {"obs": rows.numpy()})
    np.testing.assert_allclose(actions, acted[1], rtol=0, atol=1e-6)
