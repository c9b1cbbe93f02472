"""Terminations: failures and time-outs."""

from __future__ import annotations

import pytest
import torch

from mjlab.managers import TerminationManager, TerminationTermCfg


def term(name, time_out=False):
    return TerminationTermCfg(func=lambda env: env.values[name], time_out=time_out)


@pytest.fixture
def manager(env):
    env.values = {
        "fell": torch.tensor([True, False, True, False]),
        "late": torch.tensor([True, True, False, False]),
        "broke": torch.tensor([False, False, False, False]),
    }
    cfg = {"fell": term("fell"), "late": term("late", time_out=True), "broke": term("broke")}
    return TerminationManager(cfg, env)


def test_nothing_has_ended_before_the_first_step(manager):
    assert not manager.dones.any()
    assert not manager.terminated.any()
    assert not manager.time_outs.any()


def test_failures_and_time_outs_are_kept_apart(manager):
    dones = manager.compute()
    assert dones.tolist() == [True, True, True, False]
    assert manager.dones is dones
    assert manager.terminated.tolist() == [True, False, True, False]
    assert manager.time_outs.tolist() == [True, True, False, False]


def test_an_end_does_not_outlast_its_step(manager, env):
    manager.compute()
    env.values = {name: torch.zeros(4, dtype=torch.bool) for name in env.values}
    assert not manager.compute().any()


def test_a_curriculum_may_turn_a_term_into_a_time_out(manager):
    manager.get_term_cfg("fell").time_out = True
    manager.compute()
    assert not manager.terminated.any()
    assert manager.time_outs.tolist() == [True, True, True, False]


def test_reset_counts_environments_and_keeps_values(manager):
    manager.compute()
    log = manager.reset(torch.tensor([0, 1]))
    assert log == {
        "Episode_Termination/fell": 1,
        "Episode_Termination/late": 2,
        "Episode_Termination/broke": 0,
    }
    assert manager.reset(torch.tensor([0, 1])) == log
    assert manager.reset(None)["Episode_Termination/fell"] == 2
    assert manager.reset(torch.tensor([], dtype=torch.long)) == {}


def test_get_term_returns_the_last_value_or_lists_names(manager, env):
    manager.compute()
    assert torch.equal(manager.get_term("late"), env.values["late"])
    with pytest.raises(KeyError, match=r"'fall'.*\['fell', 'late', 'broke'\]"):
        manager.get_term("fall")


def test_one_environment_is_shown_as_zeros_and_ones(manager):
    manager.compute()
    assert manager.get_active_iterable_terms(0) == [
        ("fell", [1.0]),
        ("late", [1.0]),
        ("broke", [0.0]),
    ]


def test_values_that_are_numbers_count_as_true_unless_zero(env):
    env.values = {"a": torch.tensor([0.0, 0.5, -1.0, 0.0])}
    assert TerminationManager({"a": term("a")}, env).compute().tolist() == [
        False,
        True,
        True,
        False,
    ]


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_buffers_of_earlier_releases(env):
    cfg = {
        "late": TerminationTermCfg(func=lambda env: env.value > 1.0, time_out=True),
        "fallen": TerminationTermCfg(func=lambda env: env.value > 0.0),
    }
    manager = TerminationManager(cfg, env)
    env.value = torch.tensor([0.0, 1.0, 2.0, 0.0])
    manager.compute()
    assert manager._terminated_buf is manager.terminated
    assert manager._truncated_buf is manager.time_outs
    assert {name: values.tolist() for name, values in manager._term_dones.items()} == {
        "late": [False, False, True, False],
        "fallen": [False, True, True, False],
    }
    manager._terminated_buf[0] = True
    manager._term_dones["late"][3] = True
    assert manager.terminated[0]
    assert manager.get_term("late")[3]
