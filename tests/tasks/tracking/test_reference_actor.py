"""Reference actor of the `cpu` profile: targets the reference pose before training."""

from __future__ import annotations

import onnxruntime
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from tracking_tasks import G1, G1_BLIND

from mjlab.envs import mdp
from mjlab.managers import ObservationTermCfg
from mjlab.rl.exporter_utils import load_onnx_policy
from mjlab.tasks.tracking.rl.reference_actor import ReferenceActor

ACTOR = "mjlab.tasks.tracking.rl.reference_actor:ReferenceActor"


def wanted_actions(runner) -> torch.Tensor:
    """Return the actions that target the reference pose, computed from the terms."""
    env, command = runner.env.unwrapped, runner.motion_command
    term = env.action_manager.get_term("joint_pos")
    joints = [command.robot.joint_names.index(name) for name in term.target_names]
    return (command.joint_pos[:, joints] - term.offset) / term.scale


def forget_what_is_learned(actor: ReferenceActor) -> None:
    for parameter in actor.with_reference.mlp.parameters():
        torch.nn.init.zeros_(parameter)


def shift(cfg) -> None:
    """Put another term before the command."""
    terms = cfg.observations["actor"].terms
    gravity = ObservationTermCfg(func=mdp.projected_gravity)
    cfg.observations["actor"].terms = {"gravity": gravity, **terms}


@pytest.mark.parametrize("edit", [None, shift])
@pytest.mark.parametrize("task", [G1, G1_BLIND])
def test_the_actor_asks_for_the_reference(make_runner, task, edit):
    runner = make_runner(task=task, actor=ACTOR, edit=edit)
    actor = runner.alg.get_policy()
    forget_what_is_learned(actor)
    obs = runner.env.get_observations()
    # Updates of the observation statistics must not change the target pose.
    for _ in range(3):
        actor.update_normalization(obs)
    torch.testing.assert_close(actor(obs), wanted_actions(runner), atol=1e-4, rtol=1e-4)


def test_what_is_learned_is_added_and_little_at_first(make_runner):
    runner = make_runner(actor=ACTOR)
    actor, obs = runner.alg.get_policy(), runner.env.get_observations()
    learned = actor(obs) - wanted_actions(runner)
    assert 0.0 < learned.abs().max() < 0.1


def test_training_changes_what_is_learned_alone_and_checkpoints_keep_it(make_runner, tmp_path):
    runner = make_runner(tmp_path / "run", actor=ACTOR)
    actor = runner.alg.get_policy()
    # Values that differ from those of a new runner, so that they must come from the checkpoint.
    actor.with_reference.weight.mul_(1.5)
    actor.with_reference.bias.add_(0.25)
    weight = actor.with_reference.weight.clone()
    before = actor.with_reference.mlp[0].weight.detach().clone()
    runner.learn(2)
    assert torch.equal(actor.with_reference.weight, weight)
    assert not torch.equal(actor.with_reference.mlp[0].weight, before)
    other = make_runner(actor=ACTOR)
    other.load(str(tmp_path / "run" / "model_1.pt"))
    obs = runner.env.get_observations()
    actor.eval()
    policy = other.alg.get_policy().eval()
    torch.testing.assert_close(policy(obs), actor(obs))


def test_checkpoints_hold_what_is_learned_once(make_runner):
    actor = make_runner(actor=ACTOR).alg.get_policy()
    weights = [name for name in actor.state_dict() if name.endswith("weight")]
    assert weights == ["mlp.weight", "mlp.mlp.0.weight", "mlp.mlp.2.weight"]
    assert actor.with_reference is actor.mlp


def test_the_export_asks_for_the_same(make_runner, tmp_path):
    runner = make_runner(tmp_path / "run", actor=ACTOR)
    runner.learn(2)
    session = onnxruntime.InferenceSession(tmp_path / "run" / "run.onnx")
    actor, obs = runner.alg.get_policy().eval(), runner.env.get_observations()
    played = load_onnx_policy(tmp_path / "run" / "run.onnx", runner.env, "cpu")
    torch.testing.assert_close(played(obs), actor(obs), atol=1e-4, rtol=1e-4)
    for row, expected in zip(obs["actor"], actor(obs).detach(), strict=True):
        inputs = {"obs": row[None].numpy(), "time_step": torch.zeros(1, 1).numpy()}
        exported = torch.from_numpy(session.run(["actions"], inputs)[0][0])
        torch.testing.assert_close(exported, expected, atol=1e-4, rtol=1e-4)


def scale_by_one_number(cfg) -> None:
    action = cfg.actions["joint_pos"]
    action.scale, action.offset, action.use_default_offset = 0.5, 0.1, False


class OneDevice(TorchDispatchMode):
    """Raises like a GPU: only copies may mix tensors of several devices."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        tensors = [leaf for leaf in tree_leaves(args) if isinstance(leaf, torch.Tensor)]
        devices = {tensor.device.type for tensor in tensors}
        assert len(devices) < 2 or "copy" in str(func), (func, devices)
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("edit", [None, scale_by_one_number])
def test_actions_may_have_one_scale_and_offset_for_all_joints(make_runner, edit):
    runner = make_runner(actor=ACTOR, edit=edit)
    actor = runner.alg.get_policy()
    forget_what_is_learned(actor)
    obs = runner.env.get_observations()
    torch.testing.assert_close(actor(obs), wanted_actions(runner), atol=1e-4, rtol=1e-4)
    # Scale and offset are moved to the device of the networks.
    actor.to("meta")
    with OneDevice():
        actor.follow(runner.env.unwrapped, runner.motion_command)


@pytest.mark.parametrize("kind", ["HeteroscedasticGaussianDistribution", "BetaDistribution"])
def test_distributions_that_take_more_than_the_mean_are_refused(make_runner, kind):
    with pytest.raises(ValueError, match=f"{kind}.* use 'GaussianDistribution'"):
        make_runner(actor=ACTOR, distribution={"class_name": kind})


def scale_command(cfg) -> None:
    cfg.observations["actor"].terms["command"].scale = 0.5


def drop_command(cfg) -> None:
    cfg.observations["actor"].terms.pop("command")


def relative_actions(cfg) -> None:
    cfg.actions["joint_pos"] = mdp.RelativeJointPositionActionCfg(
        entity_name="robot", actuator_names=(".*",)
    )


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (scale_command, "observations: expected the motion command"),
        (drop_command, "observations: expected the motion command"),
        (relative_actions, "expected one JointPositionAction"),
    ],
)
def test_what_cannot_be_followed_is_refused_when_training_is_built(make_runner, edit, message):
    with pytest.raises(ValueError, match=message):
        make_runner(actor=ACTOR, edit=edit)
