"""Profile of a step: consistent sums, and an unchanged environment."""

from __future__ import annotations

import time
from typing import Any

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.envs.mdp.rewards import is_alive
from mjlab.envs.profiling import profiled_steps
from mjlab.managers import (
    CommandTerm,
    CommandTermCfg,
    CurriculumTermCfg,
    EventTermCfg,
    ManagerTermBase,
    MetricsTermCfg,
    RecorderTerm,
    RecorderTermCfg,
    RewardTermCfg,
)
from mjlab.tasks.registry import load_env_cfg

STEPS = 6
NAP = 0.02


class Slow(ManagerTermBase):
    """A reward that takes its time, also when it is reset."""

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(env)
        self.calls = 0

    def reset(self, env_ids: Any) -> None:
        self.calls += 1

    def __call__(self, env: Any) -> torch.Tensor:
        time.sleep(NAP)
        return torch.zeros(env.num_envs)


class Forwarding(CommandTerm):
    """Command that calls `forward` itself, and calls another manager's term."""

    @property
    def command(self) -> torch.Tensor:
        return torch.zeros(self.num_envs, 1)

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        """Draw nothing."""

    def _update_command(self, env_ids: torch.Tensor | None) -> None:
        time.sleep(NAP)
        self._env.sim.forward()
        self._env.reward_manager.get_term_cfg("smooth_reward")


class ForwardingCfg(CommandTermCfg):
    def build(self, env: Any) -> CommandTerm:
        return Forwarding(self, env)


def nothing(env: Any, env_ids: Any) -> None:
    """Do nothing."""


def make_env(engine: str = "native") -> ManagerBasedRlEnv:
    cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
    cfg.scene.num_envs = 4
    cfg.sim.engine = engine  # ty: ignore
    cfg.sim.num_threads = 1
    # Every third step resets.
    cfg.episode_length_s = 0.15
    cfg.rewards["slow"] = RewardTermCfg(func=Slow, weight=1.0)
    cfg.commands["forwarding"] = ForwardingCfg(resampling_time_range=(0.1, 0.1))
    cfg.curriculum["stage"] = CurriculumTermCfg(func=nothing)
    cfg.metrics["alive"] = MetricsTermCfg(func=is_alive, per_substep=True)
    cfg.recorders["look"] = RecorderTermCfg(func=RecorderTerm)
    cfg.events["every"] = EventTermCfg(func=nothing, mode="step")
    cfg.seed = 1
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    return env


def step(env: ManagerBasedRlEnv, count: int) -> None:
    for _ in range(count):
        env.step(torch.zeros(env.num_envs, 1))


@pytest.fixture(scope="module")
def measured():
    """Return an environment and the profile of some of its steps."""
    env = make_env()
    with profiled_steps(env) as profile:
        step(env, STEPS)
    yield env, profile
    env.close()


def test_profiled_times_add_up(measured):
    _, profile = measured
    assert profile.num_steps == STEPS
    assert 0.0 < sum(profile.phases.values()) <= profile.step_time
    assert profile.other == profile.step_time - sum(profile.phases.values())
    for manager, terms in profile.terms.items():
        assert sum(terms.values()) <= profile.phases[manager]


def test_every_manager_and_every_term_is_there(measured):
    env, profile = measured
    assert {name: list(terms) for name, terms in profile.terms.items()} == {
        "actions": ["effort"],
        "terminations": ["time_out"],
        "rewards": ["smooth_reward", "slow"],
        "metrics": ["alive"],
        "events": ["reset_slider", "reset_hinge", "every"],
        "curriculum": ["stage"],
        "commands": ["forwarding"],
        "observations": [
            f"{group}/{term}"
            for group, terms in env.observation_manager.active_terms.items()
            for term in terms
        ],
        "recorders": ["look"],
    }
    assert set(profile.phases) == {
        *profile.terms, "physics", "forward", "sense", "actuators", "sensors", "reset",
    }  # fmt: skip
    assert [term for terms in profile.terms.values() for term in terms.values() if term <= 0] == []
    assert [name for name, seconds in profile.phases.items() if seconds <= 0] == []


def test_time_is_that_of_who_spent_it(measured):
    _, profile = measured
    for manager, term in (("rewards", "slow"), ("commands", "forwarding")):
        assert STEPS * NAP <= profile.terms[manager][term] <= profile.phases[manager]
    # Calls made by a command count as time of the command.
    assert profile.phases["forward"] < STEPS * NAP
    assert profile.terms["rewards"]["smooth_reward"] < STEPS * NAP
    assert profile.milliseconds(profile.step_time) == pytest.approx(1e3 * profile.step_time / STEPS)
    assert profile.percent(profile.step_time) == 100.0


def parts(env: ManagerBasedRlEnv) -> list[Any]:
    """Return everything that is instrumented."""
    managers = [value for name, value in vars(env).items() if name.endswith("_manager")]
    terms = [t for m in managers for t in [*vars(m).get("_terms", {}).values()]]
    terms += [t for m in managers for t in m._class_terms.values()]
    terms += [t for g in env.observation_manager._groups.values() for t in g.terms.values()]
    return [env, env.sim, env.scene, *managers, *terms]


def attributes(env: ManagerBasedRlEnv) -> list[Any]:
    configs = [cfg for part in parts(env) for cfg in vars(part).get("_term_cfgs", ())]
    return [set(vars(part)) for part in parts(env)] + [id(cfg.func) for cfg in configs]


@pytest.mark.parametrize("fails", [False, True])
def test_nothing_is_left_behind(fails):
    env = make_env()
    step(env, 1)
    before = attributes(env)
    try:
        with profiled_steps(env) as profile:
            assert attributes(env) != before
            step(env, 1)
            if fails:
                raise RuntimeError("on the way")
    except RuntimeError:
        assert fails
    assert attributes(env) == before
    assert env.step.__func__ is ManagerBasedRlEnv.step
    time_before = profile.step_time
    step(env, 1)
    assert (profile.num_steps, profile.step_time) == (1, time_before)
    env.close()


def test_profiling_changes_no_number():
    plain, profiled = make_env(), make_env()
    for env, count in ((plain, 5), (profiled, 1)):
        torch.manual_seed(3)
        step(env, count)
    with profiled_steps(profiled):
        step(profiled, 4)
    assert torch.equal(plain.sim.data.qpos, profiled.sim.data.qpos)
    assert torch.equal(plain.reward_buf, profiled.reward_buf)
    plain.close()
    profiled.close()


def test_a_step_that_fails_is_not_counted():
    env = make_env()
    with profiled_steps(env) as profile:
        with pytest.raises(ValueError, match="shape"):
            env.step(torch.zeros(3, 1))
        step(env, 1)
    assert profile.num_steps == 1
    env.close()


@pytest.mark.slow
def test_it_works_on_warp():
    env = make_env("warp")
    with profiled_steps(env) as profile:
        step(env, 2)
    assert profile.phases["physics"] > 0
    env.close()
