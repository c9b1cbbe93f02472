"""Policy settings read from the files of a run."""

from __future__ import annotations

import json
import shutil

import pytest
import torch
import yaml
from rsl_rl.utils import resolve_callable

from mjlab.rl.learners import acting_cfg
from mjlab.runs import Run
from mjlab.runs.folder import write_info
from mjlab.runs.policy import constant_policy
from mjlab.tasks.registry import load_rl_cfg

TASK = "Mjlab-Cartpole-Swingup"


def agent_cfg_beside(folder, params):
    (folder / "params").mkdir()
    (folder / "params" / "agent.yaml").write_text(yaml.safe_dump(params))
    return acting_cfg(Run(folder, TASK).cfg().agent)


def test_sizes_of_the_run_replace_those_of_the_task(tmp_path):
    cfg = agent_cfg_beside(
        tmp_path, {"actor": {"hidden_dims": [8, 4], "activation": "relu", "rnn_num_layers": 2}}
    )
    assert cfg["actor"]["hidden_dims"] == (8, 4)
    assert cfg["actor"]["activation"] == "relu"
    assert cfg["actor"]["rnn_num_layers"] == 2
    assert cfg["critic"] == agent_cfg_of_task()["critic"]


def test_encoders_of_the_run_replace_those_of_the_task(tmp_path):
    encoder = {"camera": {"output_channels": [4, 8], "padding": "zeros", "max_pool": False}}
    cfg = agent_cfg_beside(tmp_path, {"critic": {"cnn_cfg": encoder}})
    assert cfg["critic"]["cnn_cfg"] == encoder
    assert cfg["actor"] == agent_cfg_of_task()["actor"]


def agent_cfg_of_task():
    return acting_cfg(load_rl_cfg(TASK))


REFERENCE_ACTOR = "mjlab.tasks.tracking.rl.reference_actor:ReferenceActor"
CLASSES = [
    "MLPModel",
    "CNNModel",
    "RNNModel",
    "mjlab.rl.sac_models:SacActorModel",
    "mjlab.rl.sac_models:TwinCriticModel",
    "mjlab.rl.spatial_softmax:SpatialSoftmaxCNNModel",
    REFERENCE_ACTOR,
]


@pytest.mark.parametrize("name", CLASSES)
def test_classes_of_the_run_replace_those_of_the_task_if_they_are_known(tmp_path, name):
    cfg = agent_cfg_beside(tmp_path, {"actor": {"class_name": name}})
    assert cfg["actor"] == {**agent_cfg_of_task()["actor"], "class_name": name}
    assert issubclass(resolve_callable(name), torch.nn.Module)


TRACKING = "Mjlab-Tracking-Flat-Unitree-G1"


@pytest.mark.parametrize(
    ("profile", "name"),
    [
        pytest.param("cpu", None, marks=pytest.mark.slow),
        ("cpu", "MLPModel"),
        pytest.param(None, REFERENCE_ACTOR, marks=pytest.mark.slow),
    ],
)
def test_runs_of_tracking_keep_their_class(run, tmp_path, profile, name):
    common = ("--log-root", str(tmp_path), "--device", "cpu")
    flags = ["--num-envs", "4", "--agent.max-iterations", "2", "--agent.num-steps-per-env", "4"]
    for network in ("actor", "critic"):
        flags += [f"--agent.{network}.hidden-dims", "(8,)"]
    flags += [] if profile is None else ["--profile", profile]
    flags += [] if name is None else ["--agent.actor.class-name", name]
    outcome = run("train", TRACKING, *common, *flags)
    assert outcome.status == 0, outcome.err
    short = ("--num-episodes", "2", "--max-steps", "3", "--json")
    outcome = run("evaluate", TRACKING, *common, *short)
    assert outcome.status == 0, outcome.err
    assert json.loads(outcome.out)["num_episodes"] == 2
    outcome = run("play", TRACKING, *common, "--viewer", "none", "--num-steps", "2")
    assert outcome.status == 0, outcome.err
    (checkpoint,) = tmp_path.glob("*/*/model_1.pt")
    weights = torch.load(checkpoint, weights_only=False)["actor_state_dict"]
    assert ("mlp.mlp.0.weight" in weights) == (name != "MLPModel")


def test_settings_that_no_network_has_are_said_to_be_the_runs(run, trained, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(trained, folder)
    settings = Run(folder).settings
    write_info(folder, settings={**settings, "agent.actor.activation": "nonsense"})
    checkpoint = str(next(folder.glob("model_*.pt")))
    outcome = run("evaluate", TASK, "--device", "cpu", "--checkpoint-file", checkpoint)
    assert outcome.status == 1
    assert "agent.yaml" in outcome.message
    assert "nonsense" in outcome.message


@pytest.mark.parametrize(
    "actor",
    [
        {"class_name": "pydoc:pipepager"},
        {"class_name": ["MLPModel"]},
        {"distribution_cfg": {"class_name": "pydoc:pipepager", "cmd": "touch pwned"}},
        {"cnn_cfg": {"class_name": "os:system"}},
        {"cnn_cfg": {"activation": {"deep": ["os:system"]}}},
        {"cnn_cfg": "os:system"},
        {"hidden_dims": "nonsense"},
        {"hidden_dims": [64.5]},
        {"activation": "os:system"},
        {"obs_normalization": "yes"},
        {"rnn_type": "subprocess:run"},
        3,
        None,
    ],
)
def test_nothing_else_in_a_run_folder_reaches_the_networks(tmp_path, actor):
    params = {"actor": actor, "obs_groups": {"actor": ["os:system"]}, "class_name": "os:system"}
    assert agent_cfg_beside(tmp_path, params) == agent_cfg_of_task()


def test_a_run_folder_that_says_nothing_leaves_the_task_as_it_is(tmp_path):
    assert acting_cfg(Run(tmp_path, TASK).cfg().agent) == agent_cfg_of_task()


def test_constant_policies_have_the_shape_of_the_actions():
    from types import SimpleNamespace

    env = SimpleNamespace(num_envs=3, num_actions=2, device="cpu")
    assert constant_policy(env, "zero")(None).abs().sum() == 0
    random = constant_policy(env, "random")(None)
    assert random.shape == (3, 2)
    assert random.abs().max() <= 1


def test_fields_of_the_environment_are_flags_of_evaluate_and_play(run):
    zero = ("--agent", "zero", "--env.episode-length-s", "0.5")
    scored = run("evaluate", TASK, *zero, "--num-episodes", "4", "--json", "True")
    assert scored.status == 0
    assert '"mean_length": 10.0' in scored.out
    played = run("play", TASK, *zero, "--viewer", "none", "--num-steps", "30", "--num-envs", "2")
    assert played.status == 0
    assert "6 episodes ended" in played.out


@pytest.mark.parametrize(("flag", "value"), [("--port", "99999"), ("--port", "0")])
def test_numbers_of_play_that_cannot_be_are_refused(run, flag, value):
    outcome = run("play", TASK, "--agent", "zero", flag, value)
    assert outcome.status == 1
    assert flag in outcome.message
    assert value in outcome.message
