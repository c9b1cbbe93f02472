"""Robots whose physics diverges: training ends with the joint, its speed and a cure."""

from __future__ import annotations

from dataclasses import asdict
from types import SimpleNamespace

import mujoco
import pytest
import torch

from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg, mdp
from mjlab.managers import (
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    TerminationTermCfg,
)
from mjlab.rl import MjlabOnPolicyRunner, RslRlOnPolicyRunnerCfg, RslRlVecEnvWrapper
from mjlab.rl.rollout_watch import DivergedError, RolloutWatch
from mjlab.rl.run_logger import TrainingObserver
from mjlab.scene import SceneCfg
from mjlab.sim import MujocoCfg, SimulationCfg

# A finger of a few grams at the end of an arm.
ARM = """<mujoco><worldbody><body name="arm" pos="0 0 1"><joint name="shoulder" axis="0 1 0"/>
  <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass=".3"/>
  <body pos=".3 0 0"><joint name="elbow" axis="0 1 0"/>
  <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass=".2"/>
  <body pos=".3 0 0"><joint name="finger" axis="0 1 0"/>
  <geom type="capsule" size=".005" fromto="0 0 0 .05 0 0" mass=".005"/></body></body></body>
  </worldbody></mujoco>"""


@pytest.fixture
def make_runner(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    built = []

    def make(timestep=0.02, normalized=False, **fields):
        servo = BuiltinPositionActuatorCfg(
            target_names_expr=(".*",), stiffness=60.0, damping=3.0, effort_limit=8.0, **fields
        )
        articulation = EntityArticulationInfoCfg(actuators=(servo,))
        robot = EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_string(ARM), articulation=articulation)
        terms = {
            "pos": ObservationTermCfg(func=mdp.joint_pos_rel),
            "vel": ObservationTermCfg(func=mdp.joint_vel_rel),
        }
        action = mdp.JointPositionActionCfg(entity_name="robot", actuator_names=(".*",), scale=0.5)
        cfg = ManagerBasedRlEnvCfg(
            decimation=2,
            episode_length_s=4.0,
            seed=1,
            scene=SceneCfg(num_envs=8, entities={"robot": robot}),
            sim=SimulationCfg(engine="native", mujoco=MujocoCfg(timestep=timestep)),
            observations={name: ObservationGroupCfg(terms=terms) for name in ("actor", "critic")},
            actions={"joints": action},
            rewards={"slow": RewardTermCfg(func=mdp.joint_vel_l2, weight=-1e-3)},
            terminations={"end": TerminationTermCfg(func=mdp.time_out, time_out=True)},
        )
        env = ManagerBasedRlEnv(cfg, device="cpu")
        built.append(env)
        train = asdict(RslRlOnPolicyRunnerCfg(num_steps_per_env=16, max_iterations=30))
        train["obs_groups"] = {"actor": ("actor",), "critic": ("critic",)}
        for network in ("actor", "critic"):
            train[network]["hidden_dims"] = (8,)
            train[network]["obs_normalization"] = normalized
        return MjlabOnPolicyRunner(RslRlVecEnvWrapper(env), train, None, "cpu")

    yield make
    for env in built:
        env.close()
    assert not list(tmp_path.iterdir()), (
        "MuJoCo writes its warnings to a file unless they are collected"
    )


@pytest.mark.parametrize("normalized", [False, True])
def test_training_names_the_joint_its_speed_and_the_cure(make_runner, normalized):
    with pytest.raises(DivergedError, match=r"joint 'robot/finger' reached .* rad/s") as caught:
        make_runner(normalized=normalized).learn(30)
    for part in (
        "8 of 8",
        "timestep of 0.02 s",
        "armature (now 0)",
        "viscous_damping",
        "effort_limit",
    ):
        assert part in str(caught.value)


@pytest.mark.parametrize("cure", [{"armature": 0.01}, {"viscous_damping": 0.5}])
def test_what_the_message_advises_cures_it(make_runner, cure):
    runner = make_runner(**cure)
    runner.learn(2)
    assert runner.current_learning_iteration == 2


class BreaksPolicy(TrainingObserver):
    """Leaves between two iterations what a diverged rollout may: a policy of NaN, and slow joints."""

    def __init__(self, runner):
        self.runner = runner

    def on_iteration(self, stats):
        self.runner.env.unwrapped.sim.data.qvel.zero_()
        with torch.no_grad():
            next(self.runner.alg.get_policy().parameters()).fill_(float("nan"))


def test_nan_at_the_first_action_of_the_next_rollout_is_explained(make_runner):
    runner = make_runner(armature=0.01)
    # Too fast for the time step, though not enough to break the policy within the first rollout.
    runner.env.unwrapped.sim.data.qvel[:, 2] = 200.0
    runner.observers.append(BreaksPolicy(runner))
    with pytest.raises(DivergedError, match=r"joint 'robot/.*' reached .* rad/s") as caught:
        runner.learn(2)
    assert caught.value.__cause__ is not None
    assert runner.current_learning_iteration == 1


def test_a_policy_that_breaks_on_its_own_is_named(make_runner):
    runner = make_runner(armature=0.01)
    with torch.no_grad():
        for parameter in runner.alg.get_policy().parameters():
            parameter.fill_(float("nan"))
    with pytest.raises(DivergedError, match="weights are NaN.*learning rate") as caught:
        runner.learn(1)
    assert "joint" not in str(caught.value)


@pytest.mark.parametrize("part", ["weight", "moment", "statistic"])
def test_nothing_is_saved_that_cannot_be_loaded(make_runner, monkeypatch, part):
    runner = make_runner(armature=0.01, normalized=True)
    optimizer, update = runner.alg.optimizer, runner.alg.update

    def breaks():
        losses = update()
        weight = next(runner.alg.critic.mlp.parameters())
        moment = optimizer.state[weight]["exp_avg_sq"]
        statistic = runner.alg.critic.obs_normalizer._var
        chosen = {"weight": weight.data, "moment": moment, "statistic": statistic}[part]
        chosen.view(-1)[0] = float("inf")
        return losses

    monkeypatch.setattr(runner.alg, "update", breaks)
    entry = {"weight": "critic.*weight", "moment": "exp_avg_sq", "statistic": "critic.*_var"}[part]
    with pytest.raises(DivergedError, match=f"infinite, first .*{entry}"):
        runner.learn(1)


def test_infinity_from_the_start_is_meant():
    meant, learned = torch.tensor(-torch.inf), torch.tensor(0.0)
    algorithm = SimpleNamespace(save=lambda: {"meant": meant, "learned": [learned]})
    watch = RolloutWatch(SimpleNamespace(), algorithm)
    with watch.explaining(algorithm):
        pass
    with pytest.raises(DivergedError), watch.explaining(algorithm):
        learned.fill_(torch.inf)


@pytest.mark.parametrize("value", [float("inf"), 1e38])
def test_observations_that_break_the_policy_are_named(make_runner, value):
    runner = make_runner(armature=0.01, normalized=True)
    env = runner.env.unwrapped
    term = env.observation_manager.get_term_cfg("critic", "vel")
    term.func = lambda env: torch.full((8, 3), value)
    with pytest.raises(DivergedError, match=r"'critic' reach (inf|1e\+38): scale or clip"):
        runner.learn(5)


def test_an_error_that_is_not_about_numbers_passes(make_runner, monkeypatch):
    runner = make_runner(armature=0.01)

    def fail(*args, **kwargs):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(runner.alg, "update", fail)
    with pytest.raises(RuntimeError, match="out of memory"):
        runner.learn(1)
