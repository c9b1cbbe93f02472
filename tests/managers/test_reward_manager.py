"""Rewards: weighted sums over terms and over episodes."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.managers import RewardManager, RewardTermCfg


def term(name, weight=1.0):
    return RewardTermCfg(func=lambda env: env.values[name], weight=weight)


finite = st.floats(-100.0, 100.0, width=32)


@given(
    values=st.lists(st.lists(finite, min_size=4, max_size=4), min_size=1, max_size=4),
    weights=st.lists(st.floats(-3.0, 3.0, width=32), min_size=4, max_size=4),
    dt=st.floats(0.01, 0.1),
    scale_by_dt=st.booleans(),
)
@settings(deadline=None, max_examples=50)
def test_the_reward_is_the_weighted_sum_of_terms(make_env, values, weights, dt, scale_by_dt):
    env = make_env()
    env.values = dict(enumerate(torch.tensor(values)))
    cfg = {str(k): term(k, weights[k]) for k in env.values}
    manager = RewardManager(cfg, env, scale_by_dt=scale_by_dt)
    scale = dt if scale_by_dt else 1.0
    expected = sum(env.values[k].double() * weights[k] * scale for k in env.values)
    reward = manager.compute(dt)
    torch.testing.assert_close(reward.double(), expected, rtol=1e-4, atol=1e-4)
    # The rates by term, which viewers read, add up to the same.
    torch.testing.assert_close(manager._step_reward.sum(dim=1) * scale, reward)
    assert manager._step_reward.shape == (4, len(values))


def test_episode_sums_are_logged_at_resets(env):
    env.values = {"a": torch.arange(4.0), "b": torch.ones(4)}
    manager = RewardManager({"a": term("a"), "b": term("b", -2.0)}, env)
    for _ in range(5):
        manager.compute(0.02)
    log = manager.reset(torch.tensor([1, 3]))
    # Mean of 1 and 3, over 5 steps of 0.02 s, divided by episodes of 10 s.
    assert log["Episode_Reward/a"] == pytest.approx(2.0 * 0.1 / 10.0)
    assert log["Episode_Reward/b"] == pytest.approx(-2.0 * 0.1 / 10.0)
    assert log["Episode_Reward/a"].ndim == 0
    assert manager.reset(torch.tensor([1, 3]))["Episode_Reward/a"] == 0.0
    assert manager.reset(None)["Episode_Reward/a"] == pytest.approx(2.0 / 4 * 0.1 / 10.0)


def test_logged_values_do_not_change_afterwards(env):
    env.values = {"a": torch.ones(4)}
    manager = RewardManager({"a": term("a")}, env, scale_by_dt=False)
    manager.compute(0.02)
    log = manager.reset(None)
    manager.compute(0.02)
    manager.reset(None)
    assert log["Episode_Reward/a"] == pytest.approx(0.1)


def test_without_an_episode_length_plain_sums_are_logged(env):
    env.max_episode_length_s = 0.0
    env.values = {"a": torch.ones(4)}
    manager = RewardManager({"a": term("a")}, env, scale_by_dt=False)
    manager.compute(0.02)
    assert manager.reset(None)["Episode_Reward/a"] == 1.0


def test_a_reset_of_no_environment_logs_nothing(env):
    env.values = {"a": torch.ones(4)}
    manager = RewardManager({"a": term("a")}, env)
    assert manager.reset(torch.tensor([], dtype=torch.long)) == {}


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_nan_and_infinite_terms_count_as_zero(env, bad):
    env.values = {"a": torch.tensor([1.0, bad, 1.0, 1.0]), "b": torch.ones(4)}
    manager = RewardManager({"a": term("a"), "b": term("b")}, env, scale_by_dt=False)
    assert manager.compute(0.02).tolist() == [2.0, 1.0, 2.0, 2.0]
    assert manager._step_reward[1].tolist() == [0.0, 1.0]
    assert torch.isfinite(manager.reset(None)["Episode_Reward/a"])


def test_terms_of_weight_zero_are_not_called(env):
    calls = []
    cfg = {"a": RewardTermCfg(func=lambda env: calls.append(1) or torch.ones(4), weight=1.0)}
    manager = RewardManager(cfg, env)
    manager.compute(0.02)
    manager.get_term_cfg("a").weight = 0.0
    assert manager.compute(0.02).tolist() == [0.0] * 4
    assert len(calls) == 1
    assert manager._step_reward.abs().max() == 0.0


def test_parameters_of_weight_zero_are_not_checked(env):
    cfg = RewardTermCfg(func=lambda env, size: env.value * size, weight=0.0)
    manager = RewardManager({"a": cfg}, env, scale_by_dt=False)
    assert manager.compute(0.02).tolist() == [0.0] * 4
    live = manager.get_term_cfg("a")
    live.weight, live.params["size"] = 1.0, 2.0
    assert torch.equal(manager.compute(0.02), 2.0 * env.value)


def test_a_changed_weight_takes_effect_at_the_next_step(env):
    env.values = {"a": torch.ones(4)}
    manager = RewardManager({"a": term("a")}, env, scale_by_dt=False)
    manager.get_term_cfg("a").weight = 5.0
    assert manager.compute(0.02).tolist() == [5.0] * 4


@pytest.mark.parametrize("dtype", [torch.bool, torch.int64, torch.float64, torch.float32])
def test_terms_of_any_type_are_summed(env, dtype):
    env.values = {"a": torch.tensor([0, 1, 1, 0]).to(dtype)}
    manager = RewardManager({"a": term("a", 0.5)}, env, scale_by_dt=False)
    assert manager.compute(0.02).tolist() == [0.0, 0.5, 0.5, 0.0]
    assert manager.compute(0.02).dtype == torch.float32


def test_values_of_terms_are_not_written_to(env):
    env.values = {"a": torch.tensor([1.0, torch.nan, 3.0, 4.0])}
    before = env.values["a"].clone()
    RewardManager({"a": term("a", 2.0)}, env).compute(0.02)
    torch.testing.assert_close(env.values["a"], before, equal_nan=True)


def test_the_buffer_is_used_every_step(env):
    env.values = {"a": torch.ones(4)}
    manager = RewardManager({"a": term("a")}, env)
    assert manager.compute(0.02) is manager.compute(0.02)


def test_one_environment_is_shown_as_weighted_rates(env):
    env.values = {"a": torch.arange(4.0)}
    manager = RewardManager({"a": term("a", 2.0)}, env)
    manager.compute(0.02)
    assert manager.get_active_iterable_terms(3) == [("a", [6.0])]
    assert manager._term_names == ["a"]
    assert manager._term_cfgs[0].weight == 2.0


class Drawing:
    drawn = 0

    def __init__(self, cfg, env):
        pass

    def __call__(self, env):
        return env.value

    def debug_vis(self, visualizer):
        self.drawn += 1


def test_terms_that_draw_can_be_switched_off(env):
    cfg = {
        "draws": RewardTermCfg(func=Drawing, weight=1.0),
        "plain": RewardTermCfg(func=lambda env: env.value, weight=1.0),
    }
    manager = RewardManager(cfg, env)
    [(name, drawing)] = manager.get_visualizable_terms()
    assert name == "draws"
    manager.debug_vis(None)
    manager.set_debug_vis("draws", False)
    manager.debug_vis(None)
    assert drawing.drawn == 1
    manager.set_debug_vis("draws", True)
    manager.debug_vis(None)
    assert drawing.drawn == 2
    with pytest.raises(ValueError, match=r"'plain'.*\['draws'\]"):
        manager.set_debug_vis("plain", False)


@pytest.mark.parametrize("weight", [float("nan"), float("inf")])
def test_a_weight_that_is_not_finite_counts_as_zero(env, caplog, weight):
    cfg = RewardTermCfg(func=lambda env: torch.ones(4), weight=weight)
    assert RewardManager({"a": cfg}, env).compute(0.02).tolist() == [0.0] * 4
    assert "'a' was NaN or infinite" in caplog.text


def test_a_weight_may_be_a_tensor(env):
    weight = torch.tensor(2.0)
    cfg = RewardTermCfg(func=lambda env: torch.ones(4), weight=weight)  # ty: ignore
    assert RewardManager({"a": cfg}, env).compute(0.5).tolist() == [1.0] * 4
