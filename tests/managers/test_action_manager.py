"""Actions: split among terms, remembered, checked."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.actuator.actuator import constant_within_step
from mjlab.managers import ActionManager, ActionTerm, ActionTermCfg


class Keep(ActionTerm):
    """Keeps what it gets; applies nothing."""

    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self._raw_actions = torch.zeros(env.num_envs, cfg.size)
        self.applied = 0
        self.resets = []

    @property
    def action_dim(self):
        return self.cfg.size

    @property
    def raw_action(self):
        return self._raw_actions

    def process_actions(self, actions):
        self._raw_actions[:] = actions

    @constant_within_step
    def apply_actions(self):
        self.applied += 1

    def reset(self, env_ids=None):
        self.resets.append(env_ids)


class KeepEverySubstep(Keep):
    def apply_actions(self):
        self.applied += 1


@dataclass(kw_only=True)
class KeepCfg(ActionTermCfg):
    size: int
    term: type = Keep

    def build(self, env):
        return self.term(self, env)


def make(env, *sizes, **fields):
    cfg = {
        str(i): KeepCfg(entity_name="robot", size=size, **fields) for i, size in enumerate(sizes)
    }
    return ActionManager(cfg, env)


def test_terms_get_their_parts_in_order(env):
    manager = make(env, 2, 1, 3)
    assert manager.active_terms == ["0", "1", "2"]
    assert manager.action_term_dim == [2, 1, 3]
    assert manager.total_action_dim == 6
    action = torch.arange(24.0).reshape(4, 6)
    manager.process_action(action)
    parts = [manager.get_term(name).raw_action for name in manager.active_terms]
    assert torch.equal(torch.cat(parts, dim=1), action)
    assert manager.get_active_iterable_terms(1) == [
        ("0", [6.0, 7.0]),
        ("1", [8.0]),
        ("2", [9.0, 10.0, 11.0]),
    ]


@given(
    actions=st.lists(
        st.lists(st.floats(-5.0, 5.0, width=32), min_size=8, max_size=8), min_size=1, max_size=6
    ),
    reset_after=st.integers(0, 5),
)
@settings(deadline=None, max_examples=40)
def test_the_last_three_actions_are_remembered_since_the_reset(make_env, actions, reset_after):
    manager = make(make_env(), 2)
    expected = [torch.zeros(4, 2)] * 3
    for step, numbers in enumerate(actions):
        action = torch.tensor(numbers).reshape(4, 2)
        manager.process_action(action)
        expected = [action.clone(), *expected[:2]]
        if step == reset_after:
            manager.reset(torch.tensor([2]))
            for old in (expected := [old.clone() for old in expected]):
                old[2] = 0.0
    remembered = (manager.action, manager.prev_action, manager.prev_prev_action)
    for got, wanted in zip(remembered, expected, strict=True):
        assert torch.equal(got, wanted)


def test_the_callers_action_is_neither_kept_nor_changed(env):
    manager = make(env, 2)
    action = torch.ones(4, 2)
    manager.process_action(action)
    action.zero_()
    assert manager.action.tolist() == [[1.0, 1.0]] * 4
    manager.reset(None)
    assert manager.action.tolist() == [[0.0, 0.0]] * 4


def test_every_term_is_applied_and_reset(env):
    manager = make(env, 1, 1)
    manager.apply_action()
    ids = torch.tensor([3])
    manager.reset(ids)
    for name in manager.active_terms:
        assert manager.get_term(name).applied == 1
        assert manager.get_term(name).resets == [ids]


@pytest.mark.parametrize("shape", [(4, 3), (3, 2), (2,), (1, 3)])
def test_another_shape_is_refused_with_both_shapes(env, shape):
    with pytest.raises(ValueError, match=rf"\(4, 2\).*got \({shape[0]},"):
        make(env, 2).process_action(torch.zeros(shape))


def test_one_action_serves_all_environments(env):
    manager = make(env, 2)
    manager.process_action(torch.tensor([[1.0, 2.0]]))
    assert manager.action.tolist() == [[1.0, 2.0]] * 4


@pytest.mark.parametrize("dtype", [torch.bool, torch.int64, torch.float64])
def test_actions_of_every_type_become_float(env, dtype):
    manager = make(env, 2)
    manager.process_action(torch.ones(4, 2, dtype=dtype))
    assert manager.action.tolist() == [[1.0, 1.0]] * 4
    assert manager.action.dtype == torch.float32


def test_an_action_with_gradients_is_detached(env):
    manager = make(env, 2)
    for _ in range(2):
        manager.process_action(torch.ones(4, 2, requires_grad=True) * 2.0)
    assert manager.action.tolist() == [[2.0, 2.0]] * 4
    assert not manager.action.requires_grad


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_actions_that_are_not_finite_are_logged_once(env, caplog, bad):
    manager = make(env, 2)
    action = torch.ones(4, 2)
    action[2] = torch.tensor([bad, -bad])
    for _ in range(2):
        manager.process_action(action)
    assert torch.equal(manager.action.nan_to_num(9.0), action.nan_to_num(9.0))
    assert manager.bad_values.count == 1
    assert [record.getMessage().count("1 of 4 env") for record in caplog.records] == [1]


def test_large_finite_actions_are_accepted(env, caplog):
    # The sum overflows; the check must not report finite values as infinite.
    manager = make(env, 2)
    manager.process_action(torch.full((4, 2), 3e38))
    assert manager.bad_values.count == 0
    assert not caplog.records


def test_substeps_are_needed_when_a_term_acts_in_them(env):
    assert not make(env, 1, 1).needs_substep
    assert make(env, 1, term=KeepEverySubstep).needs_substep
    assert not make(env).needs_substep


def test_unknown_terms_list_the_valid_names(env):
    with pytest.raises(KeyError, match=r"'leg'.*\['0'\]"):
        make(env, 1).get_term("leg")


def test_an_unknown_entity_lists_what_there_is(env):
    with pytest.raises(KeyError, match="robot"):
        ActionManager({"a": KeepCfg(entity_name="dog", size=1)}, env)


def test_terms_may_be_of_any_class(env):
    class Own:
        action_dim = 2

        def process_actions(self, actions):
            self.raw_action = actions.clone()

        def apply_actions(self):
            self.applied = True

        def reset(self, env_ids=None):
            self.raw_action[env_ids] = 0.0

    manager = make(env, 2, term=lambda cfg, env: Own())
    assert manager.needs_substep
    manager.process_action(torch.ones(4, 2))
    manager.apply_action()
    manager.reset(torch.tensor([1]))
    own = manager.get_term("0")
    assert own.applied
    assert own.raw_action.tolist() == [[1.0, 1.0], [0.0, 0.0], [1.0, 1.0], [1.0, 1.0]]
    assert len(manager.tables()[0].rows) == 1


def test_the_config_is_kept_and_none_is_skipped(env):
    cfg = {"off": None, "a": KeepCfg(entity_name="robot", size=1)}
    manager = ActionManager(cfg, env)
    assert manager.active_terms == ["a"]
    assert manager.get_term("a").cfg is cfg["a"]
    assert manager.get_term("a")._entity is env.scene["robot"]
