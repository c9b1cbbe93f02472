"""Soft actor-critic: it learns, and the same seed gives the same weights, resumed or not."""

from __future__ import annotations

import copy
import dataclasses
import math
import os
import signal
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import onnxruntime
import pytest
import torch
from rl_fake_env import FakeEnv, FakeEnvCfg, FakeSceneCfg
from tensordict import TensorDict

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.rl.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from mjlab.rl.config import RslRlOffPolicyRunnerCfg, RslRlSacAlgorithmCfg
from mjlab.rl.sac import joint_range_bounds
from mjlab.tasks.registry import load_env_cfg


def mirror(env: Any, obs: Any = None, actions: Any = None) -> tuple[Any, Any]:
    """The fake environment is the same upside down."""
    if obs is not None:
        obs = torch.cat([obs, TensorDict({k: -v for k, v in obs.items()}, obs.batch_size)])
    if actions is not None:
        actions = torch.cat([actions, -actions])
    return obs, actions


MIRROR = {"data_augmentation_func": "test_sac:mirror"}


def make_runner(log_dir: Path | None = None, num_envs: int = 8, **changes: Any) -> Any:
    algorithm = RslRlSacAlgorithmCfg(
        batch_size=32, num_updates=2, replay_steps=20, learning_starts=3, policy_delay=2
    )
    algorithm = dataclasses.replace(algorithm, **changes)
    cfg = RslRlOffPolicyRunnerCfg(num_steps_per_env=5, save_interval=2, algorithm=algorithm)
    cfg.actor.hidden_dims = cfg.critic.hidden_dims = (16, 16)
    env = RslRlVecEnvWrapper(FakeEnv(FakeEnvCfg(scene=FakeSceneCfg(num_envs=num_envs))))
    return MjlabOnPolicyRunner(env, asdict(cfg), None if log_dir is None else str(log_dir))


def flat(value: Any, name: str = "") -> dict[str, torch.Tensor]:
    """Return copies of the tensors and numbers in nested dicts, by name."""
    if isinstance(value, dict):
        return {k: v for key, item in value.items() for k, v in flat(item, f"{name}/{key}").items()}
    if isinstance(value, torch.Tensor):
        return {name: value.clone()}
    return {name: torch.tensor(value)} if isinstance(value, int | float) else {}


def everything(runner: Any) -> dict[str, torch.Tensor]:
    """Return all that decides how training goes on, by name."""
    return flat(
        {
            "algorithm": runner.alg.save(),
            "replay": runner.alg.storage.state_dict(),
            "env": runner.env.unwrapped.state_dict(),
        }
    )


def assert_same_bits(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> None:
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert torch.equal(value, other[name]), name


VARIANTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "all": {
        "symmetry_cfg": MIRROR,
        "noise_hold": 4,
        "policy_average": 0.1,
        "num_steps_return": 3,
        "use_mixed_precision": True,
        "pessimistic": True,
    },
    "fixed range": {"value_range": (-1.0, 5.0)},
    # The fake environment's observation has as many numbers as there are actions.
    "taught": {
        "teacher": "actor",
        "teacher_steps": 12,
        "imitation": ((5, 1.0), (25, 0.0)),
        "symmetry_cfg": MIRROR,
    },
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_same_seed_gives_the_same_weights(variant):
    results = []
    for _ in range(2):
        torch.manual_seed(3)
        runner = make_runner(**VARIANTS[variant])
        runner.learn(6)
        results.append(everything(runner))
    assert_same_bits(*results)


def test_the_average_of_the_policy_slows_down_with_the_learning_rates():
    runner = make_runner(policy_average=0.5, learning_rate_factor=((0, 1.0), (15, 1.0), (16, 0.0)))
    runner.learn(2)
    moving = [p.clone() for p in runner.alg.get_policy().parameters()]
    runner.learn(4)
    held = [p.clone() for p in runner.alg.get_policy().parameters()]
    learned = [p.clone() for p in runner.alg.actor.parameters()]
    runner.learn(6)
    now = list(runner.alg.get_policy().parameters())
    assert not all(torch.equal(*pair) for pair in zip(moving, held, strict=True))
    # At a factor of 0 neither moves, although they differ.
    assert all(torch.equal(*pair) for pair in zip(held, now, strict=True))
    assert all(
        torch.equal(*pair) for pair in zip(learned, runner.alg.actor.parameters(), strict=True)
    )
    assert not all(torch.equal(*pair) for pair in zip(learned, held, strict=True))


def test_a_reversed_range_of_alpha_raises():
    with pytest.raises(ValueError, match="alpha_range: expected low <= high"):
        make_runner(alpha_range=(1.0, 0.1))


def test_to_learn_beside_the_physics_changes_no_bit():
    results = []
    for beside in (True, False):
        torch.manual_seed(3)
        runner = make_runner()
        assert runner.alg._is_concurrent
        runner.alg._is_concurrent = beside
        runner.learn(5)
        results.append(everything(runner))
    assert_same_bits(*results)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_resumed_run_takes_the_same_course(tmp_path, variant):
    torch.manual_seed(3)
    whole = make_runner(**VARIANTS[variant])
    whole.learn(7)

    torch.manual_seed(3)
    first = make_runner(tmp_path, **VARIANTS[variant])
    first.learn(4)
    torch.manual_seed(99)
    second = make_runner(tmp_path, **VARIANTS[variant])
    second.load(str(tmp_path / "model_3.pt"))
    second.learn(7)
    assert_same_bits(everything(whole), everything(second))


def test_a_run_of_another_device_resumes(tmp_path):
    runner = make_runner()
    runner.learn(1)
    runner.save(str(tmp_path / "model_0.pt"))
    content = load_checkpoint(tmp_path / "model_0.pt")
    # A generator of a GPU.
    content["sac_state_dict"]["generator"] = torch.zeros(16, dtype=torch.uint8)
    other = make_runner()
    other.load_content(content, tmp_path / "model_0.pt")
    assert other.current_learning_iteration == 1


def test_a_run_says_that_it_resumes_without_its_replay(tmp_path, caplog):
    make_runner(tmp_path, save_replay=False).learn(2)
    assert not list(tmp_path.glob("replay*"))
    resumed = make_runner(tmp_path)
    resumed.load(str(tmp_path / "model_1.pt"))
    assert "replay starts empty" in caplog.text
    resumed.learn(3)


def test_a_checkpoint_and_its_replay_have_one_identity(tmp_path):
    torch.manual_seed(3)
    make_runner(tmp_path).learn(2)
    torch.manual_seed(4)
    make_runner(tmp_path / "other").learn(2)
    replay = tmp_path / "replay_model_1.pt"
    mine, kept = (load_checkpoint(path) for path in (tmp_path / "model_1.pt", replay))
    assert isinstance(mine["identity"], str)
    assert mine["identity"] == kept["identity"]
    replay.write_bytes((tmp_path / "other" / replay.name).read_bytes())
    resumed = make_runner()
    before = everything(resumed)
    with pytest.raises(CheckpointError, match=f"{replay}.*delete this file"):
        resumed.load(str(tmp_path / "model_1.pt"))
    # Neither networks nor replay are loaded in part.
    assert_same_bits(everything(resumed), before)
    assert resumed.current_learning_iteration == 0
    replay.unlink()
    resumed.load(str(tmp_path / "model_1.pt"))
    resumed.learn(3)


def test_a_checkpoint_without_identity_takes_its_replay(tmp_path):
    make_runner(tmp_path).learn(2)
    for path in tmp_path.glob("*model_1.pt"):
        content = load_checkpoint(path)
        del content["identity"]
        save_checkpoint(content, path)
    resumed = make_runner()
    resumed.load(str(tmp_path / "model_1.pt"))
    assert resumed.alg.storage.num_filled == 10


def test_a_state_saved_again_keeps_its_identity(tmp_path):
    runner = make_runner(tmp_path)
    runner.learn(2)
    path = tmp_path / "model_1.pt"
    before = load_checkpoint(path)["identity"]
    runner.save(str(path))
    assert load_checkpoint(path)["identity"] == before
    runner.learn(3)
    assert load_checkpoint(tmp_path / "model_2.pt")["identity"] != before
    runner.load(str(path))
    runner.save(str(tmp_path / "again.pt"))
    assert load_checkpoint(tmp_path / "again.pt")["identity"] != before


def test_an_iteration_given_up_leaves_no_update():
    runner = make_runner()
    runner.learn(2)
    before = copy.deepcopy(runner.alg.save())
    runner.alg.cfg.num_updates = 400
    made = []

    def interrupt(*_: Any) -> None:
        made.append(None)
        for _ in range(2 if len(made) == 5 else 0):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.3)

    runner.alg.optimizer.register_step_post_hook(interrupt)
    runner.learn(3)
    assert runner.stop_reason == "interrupted"
    assert len(made) < 10
    for name in ("actor_state_dict", "critic_state_dict", "optimizer_state_dict", "sac_state_dict"):
        assert_same_bits(flat(before[name]), flat(runner.alg.save()[name]))


def test_what_goes_wrong_while_learning_ends_the_run():
    runner = make_runner()

    def fail(*_: Any) -> None:
        raise FloatingPointError("not today")

    runner.alg._update = fail
    with pytest.raises(FloatingPointError, match="not today"):
        runner.learn(3)


def test_it_learns_to_stay_where_rewards_are():
    torch.manual_seed(0)
    runner = make_runner(
        num_envs=32,
        actor_learning_rate=3e-3,
        critic_learning_rate=3e-3,
        replay_steps=200,
        gamma=0.9,
        target_std=0.3,
    )
    before = runner.alg._policy
    observations = TensorDict({"actor": torch.tensor([[0.8, 0.0], [0.0, -0.8]])}, batch_size=[2])
    assert torch.equal(before(observations), torch.zeros(2, 2))
    runner.learn(60)
    actions = runner.get_inference_policy()(observations)
    assert actions[0, 0] < -0.3
    assert actions[1, 1] > 0.3


def test_a_policy_learns_what_its_teacher_shows():
    torch.manual_seed(3)
    runner = make_runner(
        teacher="actor", imitation=((0, 100.0),), actor_learning_rate=3e-3, num_updates=8
    )
    runner.learn(30)
    shown = TensorDict({"actor": torch.empty(50, 2).uniform_(-0.8, 0.8)}, [50])
    distance = (runner.alg.get_policy()(shown) - shown["actor"]).abs().mean()
    assert distance < 0.1


class Shown(FakeEnv):
    """Environment with an additional observation, `shown`, equal in all environments."""

    value: float | torch.Tensor = 2.0

    def get_observations(self) -> dict[str, torch.Tensor]:
        shown = torch.as_tensor(self.value).expand(max(2, torch.as_tensor(self.value).numel()))
        return super().get_observations() | {"shown": shown.repeat(self.num_envs, 1)}


@pytest.mark.parametrize(
    ("value", "imitation"),
    [
        # No action, whatever it weighs.
        (2.0, ((0, 100.0),)),
        (math.inf, ((0, 100.0),)),
        # An action, whose weight is 0 before the first update, after 3 steps.
        (0.5, ((0, 100.0), (2, 0.0))),
    ],
)
def test_without_an_action_or_a_weight_a_teacher_changes_no_bit(monkeypatch, value, imitation):
    monkeypatch.setattr(Shown, "value", value)
    monkeypatch.setitem(globals(), "FakeEnv", Shown)
    results = []
    for changes in ({}, {"teacher": "shown", "imitation": imitation}):
        torch.manual_seed(3)
        runner = make_runner(**changes)
        runner.learn(5)
        results.append(runner.alg.save()["actor_state_dict"])
    assert_same_bits(*results)


def test_effects_of_actions_count_as_actions_do(monkeypatch):
    monkeypatch.setitem(globals(), "FakeEnv", Shown)
    found = {}
    for factor in (0.0, 2.0):
        # Two actions, and a matrix of two rows.
        monkeypatch.setattr(Shown, "value", torch.tensor([0.5, -0.3, factor, 0.0, 0.0, factor]))
        torch.manual_seed(3)
        runner = make_runner(teacher="shown", imitation=((0, 1.0),), actor_learning_rate=1e-9)
        runner.learn(1)
        found[factor] = runner.alg.update()["imitation"]
    assert found[2.0] == pytest.approx(5.0 * found[0.0], rel=1e-3)


class Strong(Shown):
    """Environment whose actions have twice the effect, and whose teacher shows half."""

    factor = 2.0

    def step(self, action: torch.Tensor):
        return super().step(self.factor * action)

    def get_observations(self) -> dict[str, torch.Tensor]:
        shown = super().get_observations()
        return shown | {"shown": shown["actor"] / self.factor}


@pytest.mark.parametrize(
    "variant",
    [
        {"noise_hold": 4, "symmetry_cfg": MIRROR},
        {"teacher": "shown", "teacher_steps": 12, "imitation": ((5, 1.0), (25, 0.0))},
    ],
)
def test_half_the_bounds_with_twice_the_effect_change_no_bit(monkeypatch, variant):
    monkeypatch.setitem(globals(), "FakeEnv", Strong)
    results = []
    for factor in (1.0, 2.0):
        monkeypatch.setattr(Strong, "factor", factor)
        bounds = [1.0 / factor, 2.0 / factor]
        monkeypatch.setattr("mjlab.rl.sac.joint_range_bounds", lambda _, b=bounds: b)
        torch.manual_seed(3)
        runner = make_runner(action_bounds="joint_ranges", **variant)
        runner.learn(6)
        results.append(everything(runner))
        policy = runner.get_inference_policy()
        results[-1]["actions"] = factor * policy(runner.env.get_observations()).detach()
    names = [name for name in results[0] if not name.endswith(("bounds", "shown"))]
    assert_same_bits(*({name: result[name] for name in names} for result in results))


@pytest.fixture
def reach():
    """Return a function that builds an environment, and returns its arm, action and bounds."""
    opened = []

    def reach(clip: float | None = None, **changes: Any) -> tuple[Any, Any, torch.Tensor]:
        cfg = load_env_cfg("Mjlab-Lift-Cube-Yam")
        cfg.scene.num_envs = 2
        cfg.actions["joint_pos"] = dataclasses.replace(cfg.actions["joint_pos"], **changes)
        opened.append(RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg, device="cpu"), clip_actions=clip))
        env = opened[-1].unwrapped
        bounds = torch.tensor(joint_range_bounds(opened[-1]))
        return env.scene["robot"].data, env.action_manager.get_term("joint_pos"), bounds

    yield reach
    for env in opened:
        env.close()


@pytest.mark.parametrize(
    "changes", [{}, {"scale": -0.1}, {"use_default_offset": False, "offset": 0.2, "scale": 0.05}]
)
def test_bounds_reach_the_ends_of_joint_ranges_or_one_scale(reach, changes):
    data, term, bounds = reach(**changes)
    ends = data.default_joint_pos_limits[0, term.target_ids]
    targets = [term.offset + sign * bounds * term.scale for sign in (-1.0, 1.0)]
    targets = torch.stack([target.expand(2, -1)[0] for target in targets], dim=1).sort(dim=1).values
    assert (targets[:, 0] <= ends[:, 0] + 1e-5).all()
    assert (targets[:, 1] >= ends[:, 1] - 1e-5).all()
    # No farther than the farther end.
    beyond = (targets - ends).abs().amin(dim=1)
    assert beyond[bounds > 1.0].max() < 1e-5
    assert bounds.min() >= 1.0


def test_bounds_are_at_most_the_clip_of_actions(reach):
    assert reach(clip=3.0)[2].max() == 3.0


def test_bounds_of_joints_without_a_range_are_one_scale(reach, monkeypatch):
    original = joint_range_bounds

    def unlimited(env: Any) -> list[float]:
        env.unwrapped.scene["robot"].data.default_joint_pos_limits[:] = torch.tensor(
            [-torch.inf, torch.inf]
        )
        return original(env)

    monkeypatch.setitem(globals(), "joint_range_bounds", unlimited)
    assert (reach()[2] == 1.0).all()


def test_a_teacher_that_weighs_nothing_is_not_compared_with():
    runner = make_runner(teacher="actor", imitation=((0, 100.0), (2, 0.0)))

    def fail(*_: Any) -> None:
        raise AssertionError

    runner.alg._teacher.distance = fail
    runner.learn(2)


def test_learning_rates_fall_with_the_steps():
    runner = make_runner(actor_learning_rate=1e-3, learning_rate_factor=((10, 1.0), (20, 0.2)))
    rates = []
    for iterations in range(1, 6):
        runner.learn(iterations)
        rates.append(runner.alg.learning_rate)
    # After 5, 10, 15, 20 and 25 environment steps.
    assert rates == pytest.approx([1e-3, 1e-3, 6e-4, 2e-4, 2e-4])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"teacher": "actor", "imitation": ((5, 1.0), (2, 0.0))}, "imitation.*increasing steps"),
        ({"teacher": "actor", "imitation": ()}, "imitation.*increasing steps"),
        ({"learning_rate_factor": ((5, 1.0), (5, 0.3))}, "learning_rate_factor.*increasing steps"),
        ({"teacher_steps": 3}, "without a teacher"),
        ({"imitation": ((0, 1.0),)}, "without a teacher"),
    ],
)
def test_points_that_would_be_silently_others_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        make_runner(**changes)


def test_the_teacher_acts_at_first_with_exploration():
    runner = make_runner(teacher="actor", teacher_steps=3)
    env, seen, shown = runner.env.unwrapped, [], []
    step = env.step

    def record(action: torch.Tensor) -> Any:
        shown.append(env.position.clone())
        seen.append(action.clone())
        return step(action)

    env.step = record
    runner.learn(1)
    near = [
        (action - position).abs()[position.abs() < 0.9].mean().item()
        for action, position in zip(seen, shown, strict=True)
    ]
    assert max(near[:3]) < 0.2 < min(near[3:])
    assert min(near[:3]) > 0.0


def test_a_teacher_that_shows_something_else_than_actions_is_refused(monkeypatch):
    monkeypatch.setitem(globals(), "FakeEnv", Shown)
    monkeypatch.setattr(Shown, "value", torch.zeros(3))
    for group, facts in (("shown", ("2 actions", "'shown'", "(3,)")), ("none", ("'none'",))):
        with pytest.raises(ValueError, match="SAC teacher") as caught:
            make_runner(teacher=group)
        assert all(fact in str(caught.value) for fact in facts)


def test_the_exported_policy_acts_as_the_policy(tmp_path):
    runner = make_runner(tmp_path)
    runner.learn(3)
    runner.export_policy_to_onnx(str(tmp_path), "policy.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    observations = runner.env.get_observations()[:1]
    (actions,) = session.run(["actions"], {"obs": observations["actor"].numpy()})
    wanted = runner.get_inference_policy()(observations).detach()
    torch.testing.assert_close(torch.from_numpy(actions), wanted, atol=1e-5, rtol=0.0)
