"""Policies that see images: networks, training, export, and playing what was exported."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from rsl_rl.models import CNNModel
from tensordict import TensorDict

from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import ObservationGroupCfg, ObservationTermCfg
from mjlab.rl import MjlabOnPolicyRunner, RslRlModelCfg, RslRlVecEnvWrapper
from mjlab.rl.config import RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg
from mjlab.rl.evaluation import evaluate_policy
from mjlab.rl.exporter_utils import OnnxPolicy, OnnxPolicyError, export_to_onnx, load_onnx_policy
from mjlab.rl.spatial_softmax import SpatialSoftmaxCNNModel
from mjlab.tasks.registry import load_env_cfg

CNN_CFG: dict[str, Any] = {
    "output_channels": (4, 6),
    "kernel_size": (5, 3),
    "stride": (2, 2),
    "padding": "zeros",
}
SOFTMAX = "mjlab.rl.spatial_softmax:SpatialSoftmaxCNNModel"
GAUSSIAN = {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "scalar"}


def picture(env: Any, size: int, channels: int) -> torch.Tensor:
    """The cart as a spot on a rail, (N, channels, size, size): a camera's image without a camera."""
    x = env.sim.data.qpos[:, 0].clamp(-1.0, 1.0)
    columns = torch.linspace(-1.0, 1.0, size)
    spot = torch.exp(-10.0 * (columns - x[:, None]).square())
    return spot[:, None, None, :].expand(-1, channels, size, -1).clone()


@pytest.fixture(scope="module")
def env() -> Iterator[RslRlVecEnvWrapper]:
    """Cartpoles with a group `camera` of 2 x 16 x 16, and `depth` of 1 x 12 x 12."""
    cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = 6, 1, "native"
    cfg.episode_length_s = 0.4
    for name, size, channels in (("camera", 16, 2), ("depth", 12, 1)):
        term = ObservationTermCfg(func=picture, params={"size": size, "channels": channels})
        cfg.observations[name] = ObservationGroupCfg(terms={"image": term})
    speed = ObservationTermCfg(func=lambda env: env.sim.data.qvel)
    cfg.observations["speed"] = ObservationGroupCfg(terms={"velocity": speed})
    wrapped = RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg, device="cpu"))
    yield wrapped
    wrapped.close()


def runner_cfg(
    actor: tuple[str, ...] = ("actor", "camera"),
    critic: tuple[str, ...] = ("critic", "camera"),
    class_name: str = SOFTMAX,
    share: bool = False,
    **network: Any,
) -> dict[str, Any]:
    settings: dict[str, Any] = {
        "hidden_dims": (8,),
        "obs_normalization": True,
        "cnn_cfg": CNN_CFG,
        "class_name": class_name,
        **network,
    }
    cfg = RslRlOnPolicyRunnerCfg(
        num_steps_per_env=4,
        obs_groups={"actor": actor, "critic": critic},
        actor=RslRlModelCfg(distribution_cfg=GAUSSIAN, **settings),
        critic=RslRlModelCfg(**settings),
        algorithm=RslRlPpoAlgorithmCfg(
            num_learning_epochs=1, num_mini_batches=2, share_cnn_encoders=share
        ),
    )
    return asdict(cfg)


Trained = Callable[..., tuple[MjlabOnPolicyRunner, Path]]


@pytest.fixture
def trained(env: RslRlVecEnvWrapper, tmp_path: Path) -> Trained:
    """Return a function that trains for two iterations and returns the runner and its export."""

    def train(**settings: Any) -> tuple[MjlabOnPolicyRunner, Path]:
        torch.manual_seed(0)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            runner = MjlabOnPolicyRunner(env, runner_cfg(**settings), str(tmp_path))
            runner.learn(2)
        return runner, tmp_path / f"{tmp_path.name}.onnx"

    return train


def onnxruntime_actions(path: Path, groups: tuple[str, ...], observations: Any) -> np.ndarray:
    """Actions of all environments, one run for each."""
    session = onnxruntime.InferenceSession(str(path))
    images = [name for name in groups if observations[name].ndim == 4]
    flat = [observations[name] for name in groups if name not in images]
    given = {name: observations[name] for name in images}
    if flat:
        given["obs"] = torch.cat(flat, dim=-1)
    assert {entry.name for entry in session.get_inputs()} == set(given)
    rows = [
        session.run(None, {name: value[row : row + 1].numpy() for name, value in given.items()})[0]
        for row in range(len(observations))
    ]
    return np.concatenate(rows)


SETTINGS = {
    "spatial softmax": {},
    "shared": {"share": True},
    "plain CNN": {"class_name": "CNNModel"},
    "plain CNN, shared": {"class_name": "CNNModel", "share": True},
    "two cameras, three groups": {
        "actor": ("depth", "speed", "camera", "actor"),
        "cnn_cfg": {"camera": CNN_CFG, "depth": {**CNN_CFG, "output_channels": (3,)}},
        "critic": ("camera", "depth", "critic"),
    },
    "images only": {"actor": ("camera",), "critic": ("camera",), "share": True},
}


@pytest.mark.parametrize("name", SETTINGS)
def test_a_trained_policy_exports_and_plays_the_same(
    name: str, env: RslRlVecEnvWrapper, trained: Trained
) -> None:
    settings: dict[str, Any] = SETTINGS[name]
    runner, path = trained(**settings)
    groups = settings.get("actor", ("actor", "camera"))
    env.reset()
    for _ in range(10):
        observations, *_ = env.step(torch.randn(env.num_envs, 1))
    policy = runner.get_inference_policy()
    with torch.inference_mode():
        expected = policy(observations)
        # The actions differ between environments: what they see matters.
        assert expected.std(dim=0).max() > 1e-4
        played = load_onnx_policy(path, env, "cpu")(observations)
    torch.testing.assert_close(played, expected, atol=1e-5, rtol=1e-4)
    np.testing.assert_allclose(
        onnxruntime_actions(path, groups, observations), expected, atol=1e-5, rtol=1e-4
    )


def test_the_export_says_what_its_inputs_are(trained: Trained) -> None:
    _, path = trained(**SETTINGS["two cameras, three groups"])
    policy = OnnxPolicy(path)
    assert policy.image_shapes == {"depth": (1, 12, 12), "camera": (2, 16, 16)}
    assert policy.metadata["image_groups"] == "depth,camera"
    assert policy.metadata["observation_group"] == "speed,actor"
    assert policy.metadata["observation_names"].startswith("velocity,")
    sizes = policy.metadata["observation_dims"].split(",")
    assert sum(map(int, sizes)) == policy.num_observations


def test_an_exported_policy_is_evaluated_like_its_checkpoint(
    env: RslRlVecEnvWrapper, trained: Trained
) -> None:
    runner, path = trained()
    policies = (runner.get_inference_policy(), OnnxPolicy(path))
    first, second = (evaluate_policy(env, policy, seed=3) for policy in policies)
    assert first.num_episodes == env.num_envs
    assert second.returns == pytest.approx(first.returns, rel=1e-4)


def test_another_camera_is_refused(trained: Trained) -> None:
    policy = OnnxPolicy(trained()[1])

    def elsewhere(**groups: tuple[int, ...]) -> Any:
        return SimpleNamespace(
            observation_manager=SimpleNamespace(group_obs_dim=groups),
            action_manager=SimpleNamespace(total_action_dim=1),
        )

    with pytest.raises(OnnxPolicyError, match=r"'camera'.*\(2, 16, 16\).*\(2, 32, 32\)"):
        policy.check_fits(elsewhere(actor=(5,), camera=(2, 32, 32)))
    with pytest.raises(OnnxPolicyError, match=r"'actor'.*no such group.*'camera'.*no such"):
        policy.check_fits(elsewhere(critic=(5,)))


def test_a_checkpoint_is_loaded_into_a_new_runner(
    env: RslRlVecEnvWrapper, trained: Trained, tmp_path: Path
) -> None:
    runner, _ = trained(share=True)
    runner.save(str(tmp_path / "m.pt"))
    other = MjlabOnPolicyRunner(env, runner_cfg(share=True))
    other.load(str(tmp_path / "m.pt"))
    observations = env.get_observations()
    with torch.inference_mode():
        torch.testing.assert_close(
            other.get_inference_policy()(observations),
            runner.get_inference_policy()(observations),
        )
    assert other.alg.actor.cnns is other.alg.critic.cnns


def test_shared_encoders_move_once_a_step(env: RslRlVecEnvWrapper) -> None:
    runner = MjlabOnPolicyRunner(env, runner_cfg(share=True))
    parameters = [p for group in runner.alg.optimizer.param_groups for p in group["params"]]
    assert len(parameters) == len(set(parameters))
    encoder = next(iter(runner.alg.actor.cnns.parameters()))
    assert any(parameter is encoder for parameter in parameters)
    # The first step of Adam is as long as the learning rate, whatever the gradient.
    before = encoder.detach().clone()
    encoder.grad = torch.ones_like(encoder)
    runner.alg.optimizer.step()
    rate = runner.alg.optimizer.param_groups[0]["lr"]
    torch.testing.assert_close(before - encoder.detach(), torch.full_like(before, rate))


def test_encoders_that_are_not_shared_are_separate(env: RslRlVecEnvWrapper) -> None:
    runner = MjlabOnPolicyRunner(env, runner_cfg())
    actor, critic = runner.alg.actor.cnns, runner.alg.critic.cnns
    assert not set(actor.parameters()) & set(critic.parameters())


def test_a_critic_that_shares_needs_no_encoder_settings(env: RslRlVecEnvWrapper) -> None:
    cfg = runner_cfg(share=True)
    cfg["critic"]["cnn_cfg"] = None
    runner = MjlabOnPolicyRunner(env, cfg)
    assert runner.alg.critic.cnns is runner.alg.actor.cnns


# Encoder configs.


@pytest.mark.parametrize(
    "extra",
    [
        {"global_pool": "avg"},
        {"global_pool": "max"},
        {"max_pool": True},
        {"norm": "batch"},
        {"norm": "layer"},
        {"padding": "reflect"},
        {"padding": "replicate"},
        {"padding": "circular"},
        {"padding": "none", "dilation": 2},
        {"activation": "gelu"},
    ],
    ids=str,
)
def test_every_kind_of_encoder_plays_from_its_export(tmp_path: Path, extra: dict) -> None:
    torch.manual_seed(0)
    observations = TensorDict(
        {"state": torch.randn(5, 7), "camera": torch.rand(5, 2, 24, 22)}, batch_size=[5]
    )
    groups = {"actor": ["state", "camera"]}
    model = CNNModel(
        observations, groups, "actor", 3, cnn_cfg={**CNN_CFG, **extra}, hidden_dims=[8]
    ).eval()
    export_to_onnx(model.as_onnx(verbose=False), tmp_path / "p.onnx")
    with torch.inference_mode():
        expected = model(observations)
        given = {"actor": observations["state"], "camera": observations["camera"]}
        played = OnnxPolicy(tmp_path / "p.onnx")(given)
    torch.testing.assert_close(played, expected, atol=1e-5, rtol=1e-4)
    actual = onnxruntime_actions(tmp_path / "p.onnx", ("state", "camera"), observations)
    np.testing.assert_allclose(actual, expected, atol=1e-5, rtol=1e-4)


def test_a_spatial_softmax_of_a_moving_spot_follows_it() -> None:
    columns = torch.linspace(-1.0, 1.0, 16)
    at = torch.tensor([-0.5, 0.0, 0.5])
    images = torch.exp(-20.0 * (columns - at[:, None]).square())[:, None, None, :]
    images = images.expand(-1, 1, 16, -1)
    observations = TensorDict({"camera": images}, batch_size=[3])
    model: Any = SpatialSoftmaxCNNModel(
        observations, {"actor": ["camera"]}, "actor", 2,
        {"output_channels": [1], "kernel_size": [3], "padding": "zeros",
         "spatial_softmax_temperature": 0.02},
    )  # fmt: skip
    convolution = model.cnns["camera"].cnn[0]
    with torch.no_grad():
        convolution.weight.fill_(1.0 / 9.0)
        features = model.cnns["camera"](images)
    torch.testing.assert_close(features[:, 1], at, atol=0.1, rtol=0.0)
    assert math.isclose(float(features[:, 0].abs().max()), 0.0, abs_tol=0.1)


# Errors when the run is built.


def edited(**changes: Any) -> dict[str, Any]:
    cfg = runner_cfg(**changes.pop("settings", {}))
    for name, value in changes.items():
        model, _, field = name.partition("__")
        cfg[model][field] = value
    return cfg


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"actor__class_name": "MLPModel", "actor__cnn_cfg": None},
            "only supports 1D observations.*'camera'",
        ),
        (
            {"actor__class_name": "RNNModel", "actor__cnn_cfg": None},
            "only supports 1D observations.*'camera'",
        ),
        ({"settings": {"actor": ("actor",)}}, "No 2D observations are provided"),
        (
            {"actor__cnn_cfg": {"depth": CNN_CFG}},
            r"cnn_cfg: expected .*\['camera'\].*got .*\['depth'\]",
        ),
        (
            {"settings": {"actor": ("actor", "camra")}},
            "'camra' in observation set 'actor' not found.*'camera'",
        ),
        (
            {"settings": {"critic": ("critic", "depth"), "share": True}},
            "2D observations must be identical",
        ),
    ],
)
def test_networks_take_their_observations(
    env: RslRlVecEnvWrapper, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        MjlabOnPolicyRunner(env, edited(**changes))
