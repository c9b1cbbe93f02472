"""Commands: when they are redrawn, and what is logged about them."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.managers import CommandManager, CommandTerm, CommandTermCfg, SceneEntityCfg


class Count(CommandTerm):
    """Its command counts the draws; its metric counts the updates."""

    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self.draws = torch.zeros(env.num_envs, 1)
        self.metrics["updates"] = torch.zeros(env.num_envs)
        self.resampled, self.updated, self.drawn = [], [], 0

    @property
    def command(self):
        return self.draws

    def _resample_command(self, env_ids):
        self.draws[env_ids] += 1.0
        self.resampled.append(env_ids.tolist())

    def _update_command(self, env_ids):
        self.updated.append(env_ids)

    def _update_metrics(self):
        self.metrics["updates"] += 1.0

    def _debug_vis_impl(self, visualizer):
        self.drawn += 1


class Rebinding(Count):
    """Puts a new tensor into its metrics at each update."""

    def _update_metrics(self):
        self.metrics["updates"] = self.metrics["updates"] + 1.0


@dataclass(kw_only=True)
class CountCfg(CommandTermCfg):
    term: type = Count

    def build(self, env):
        return self.term(self, env)


def make(env, low=1.0, high=1.0, **fields):
    manager = CommandManager({"goal": CountCfg(resampling_time_range=(low, high), **fields)}, env)
    return manager, manager.get_term("goal")


@given(
    low=st.integers(1, 4),
    extra=st.integers(0, 4),
    resets=st.lists(st.booleans(), min_size=1, max_size=20),
)
@settings(deadline=None, max_examples=40)
def test_commands_last_as_long_as_drawn(make_env, low, extra, resets):
    manager, term = make(make_env(), float(low), float(low + extra))
    manager.reset(None)
    left = term.time_left.clone()
    assert bool((left >= low).all())
    assert bool((left <= low + extra).all())
    for reset in resets:
        before, draws = term.time_left.clone(), term.draws.clone()
        dt = torch.ones(4)
        if reset:
            manager.reset(torch.tensor([1]))
            before, draws = term.time_left.clone(), term.draws.clone()
            dt[1] = 0.0
        manager.compute(dt)
        due = before - dt <= 0.0
        assert torch.equal(term.draws.flatten() - draws.flatten(), due.float())
        assert torch.equal(term.time_left[~due], (before - dt)[~due])
        assert bool((term.time_left[due] >= low).all())


def test_the_counter_counts_commands_of_the_episode(env):
    manager, term = make(env)
    manager.reset(None)
    assert term.command_counter.tolist() == [1] * 4
    manager.compute(1.0)
    assert term.command_counter.tolist() == [2] * 4
    manager.reset(torch.tensor([0]))
    assert term.command_counter.tolist() == [1, 2, 2, 2]
    assert term.command_counter.dtype == torch.int64


def test_reset_logs_and_zeroes_metrics_of_its_environments(env):
    manager, term = make(env)
    for _ in range(3):
        manager.compute(0.1)
    ids = torch.tensor([1, 2], dtype=torch.int32)
    assert manager.reset(ids) == {"Metrics/goal/updates": 3.0}
    assert term.metrics["updates"].tolist() == [3.0, 0.0, 0.0, 3.0]
    assert manager.reset(torch.tensor([], dtype=torch.long)) == {}


@pytest.mark.parametrize("shape", [(1,), (6,), (2, 3)])
def test_a_metric_with_several_values_logs_their_mean(env, shape):
    manager, term = make(env)
    term.metrics["errors"] = torch.arange(4.0).reshape(4, *(1,) * len(shape)).repeat(1, *shape)
    term.metrics["errors"][3, 0] = 9.0
    expected = term.metrics["errors"][[1, 3]].mean().item()
    assert manager.reset(torch.tensor([1, 3])) == {
        "Metrics/goal/updates": 0.0,
        "Metrics/goal/errors": pytest.approx(expected),
    }
    assert term.metrics["errors"].flatten(1).sum(dim=1).nonzero().flatten().tolist() == [2]


def test_a_partial_reset_keeps_the_state_of_other_metrics(env):
    class Distance(Count):
        """Path length: the metric needs the position before."""

        def __init__(self, cfg, env):
            super().__init__(cfg, env)
            self.before = torch.zeros(env.num_envs)

        def _update_metrics(self):
            now = self._env.value
            self.metrics["updates"] += now - self.before
            self.before = now.clone()

    manager, term = make(env, term=Distance)
    env.value = torch.full((4,), 3.0)
    manager.compute(0.0, torch.tensor([1]))
    assert term.metrics["updates"].tolist() == [0.0, 3.0, 0.0, 0.0]
    manager.compute(0.1)
    assert term.metrics["updates"].tolist() == [3.0] * 4


def test_metrics_of_several_types_are_logged_and_zeroed(env):
    manager, term = make(env)
    term.metrics |= {"count": torch.arange(4), "is_far": torch.tensor([True, False, True, True])}
    log = manager.reset(torch.tensor([1, 2]))
    assert log["Metrics/goal/count"] == 1.5
    assert log["Metrics/goal/is_far"] == 0.5
    assert term.metrics["count"].tolist() == [0, 0, 0, 3]
    assert term.metrics["is_far"].tolist() == [True, False, False, True]


@pytest.mark.parametrize("term_class", [Count, Rebinding])
def test_a_partial_reset_leaves_the_metrics_of_others_alone(env, term_class):
    manager, term = make(env, term=term_class)
    manager.compute(0.1)
    ids = torch.tensor([2])
    manager.reset(ids)
    manager.compute(0.0, env_ids=ids)
    assert term.metrics["updates"].tolist() == [1.0, 1.0, 1.0, 1.0]
    manager.compute(0.1)
    assert term.metrics["updates"].tolist() == [2.0, 2.0, 2.0, 2.0]


def test_a_partial_compute_advances_and_redraws_only_its_environments(env):
    manager, term = make(env)
    manager.reset(None)
    term.resampled.clear()
    term.time_left[:] = torch.tensor([0.5, 0.5, 2.0, 0.5])
    ids = torch.tensor([0, 2])
    manager.compute(1.0, env_ids=ids)
    assert term.resampled == [[0]]
    assert term.time_left.tolist() == [1.0, 0.5, 1.0, 0.5]
    assert term.updated[-1] is ids
    manager.compute(0.1)
    assert term.updated[-1] is None


@pytest.mark.parametrize("env_ids", [None, slice(None), torch.ones(4, dtype=torch.bool)])
def test_environments_can_be_named_in_any_way(env, env_ids):
    manager, term = make(env)
    manager.reset(env_ids)
    assert term.resampled == [[0, 1, 2, 3]]


def test_the_config_is_live(env):
    cfg = {"goal": CountCfg(resampling_time_range=(1.0, 1.0))}
    manager = CommandManager(cfg, env)
    assert manager.get_term_cfg("goal") is cfg["goal"]
    cfg["goal"].resampling_time_range = (7.0, 7.0)
    manager.reset(None)
    assert manager.get_term("goal").time_left.tolist() == [7.0] * 4


def test_commands_are_found_by_name_or_the_names_listed(env):
    manager, term = make(env)
    assert manager.get_command("goal") is term.draws
    assert manager.get_active_iterable_terms(0) == [("goal", [0.0])]
    for method, error in (
        (manager.get_command, KeyError),
        (manager.get_term, KeyError),
        (manager.get_term_cfg, ValueError),
    ):
        with pytest.raises(error, match=r"'goat'.*\['goal'\]"):
            method("goat")


def test_build_must_return_a_command(env):
    with pytest.raises(TypeError, match="'goal'.*CommandTerm.*object"):
        make(env, term=lambda cfg, env: object())


@pytest.mark.parametrize(("low", "high"), [(2.0, 1.0), (1.0, float("nan")), (float("nan"), 1.0)])
def test_a_time_range_turned_round_raises(env, low, high):
    with pytest.raises(ValueError, match=f"resampling_time_range.*{low}, {high}"):
        make(env, low, high)


def test_negative_times_resample_at_the_next_step(env):
    manager, term = make(env, -2.0, -1.0)
    manager.reset(None)
    manager.compute(0.1)
    assert term.draws.flatten().tolist() == [2.0] * 4


class Box:
    def __init__(self, value):
        self.value = value

    def on_update(self, function):
        self.change = function


def test_drawing_needs_the_config_and_the_viewers_switch(env):
    manager, term = make(env)
    manager.debug_vis(None)
    term.debug_vis(None)
    assert term.drawn == 0
    manager, term = make(env, debug_vis=True)
    manager.debug_vis(None)
    assert term.drawn == 1
    boxes, changes = {}, []

    def add_checkbox(name, initial_value):
        return boxes.setdefault(name, Box(initial_value))

    server = SimpleNamespace(gui=SimpleNamespace(add_checkbox=add_checkbox))
    manager.create_debug_vis_gui(server, on_change=lambda: changes.append(1))
    boxes["goal"].value = False
    boxes["goal"].change(None)
    manager.debug_vis(None)
    assert term.drawn == 1
    assert changes == [1]


def test_viewer_hooks_reach_every_term(env):
    class Hooked(Count):
        def create_gui(self, name, server, get_env_idx, on_change=None, request_action=None):
            self.gui = (name, server, get_env_idx(), on_change, request_action)

        def on_viewer_pause(self, paused):
            self.paused = paused

        def apply_gui_reset(self, env_ids):
            self.gui_reset = env_ids
            return self.cfg.debug_vis

    cfg = {
        str(i): CountCfg(resampling_time_range=(1.0, 1.0), term=Hooked, debug_vis=i == 0)
        for i in range(2)
    }
    manager = CommandManager(cfg, env)
    manager.create_gui("server", lambda: 3, "change", "action")
    manager.on_viewer_pause(True)
    ids = torch.tensor([0])
    assert manager.apply_gui_reset(ids) is True
    for name in "01":
        term = manager.get_term(name)
        assert term.gui == (name, "server", 3, "change", "action")
        assert term.paused is True
        assert term.gui_reset is ids, "all terms are called, even after one wrote a state"


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_metric_that_is_not_finite_in_one_environment_is_left_out_there(env, bad):
    manager, term = make(env)
    term.metrics["updates"][:] = torch.tensor([1.0, bad, 3.0, 100.0])
    ids = torch.tensor([0, 1, 2])
    assert manager.reset(ids) == {"Metrics/goal/updates": 2.0}
    term.metrics["updates"][:] = bad
    assert manager.reset(ids) == {"Metrics/goal/updates": 0.0}


@dataclass(kw_only=True)
class BrokenCfg(CountCfg):
    def build(self, env):
        raise KeyError("no such joint")


def test_an_error_while_a_command_is_built_names_it(env):
    with pytest.raises(KeyError, match="CommandManager term 'goal': no such joint"):
        CommandManager({"goal": BrokenCfg(resampling_time_range=(1.0, 1.0))}, env)


@dataclass(kw_only=True)
class SelectingCfg(CountCfg):
    asset_cfg: SceneEntityCfg


def test_selections_in_the_config_are_resolved_before_the_command_is_built(env):
    manager, term = make_selecting(env, "joint_b")
    assert term.cfg.asset_cfg.joint_ids == [1]


def test_selections_that_match_nothing_warn(env):
    with pytest.warns(UserWarning, match=r"term 'goal', field 'asset_cfg'.*knee") as caught:
        manager, term = make_selecting(env, "knee")
    assert len(caught) == 1
    assert term.cfg.asset_cfg.joint_ids == slice(None)


def make_selecting(env, joint):
    selection = SceneEntityCfg("robot", joint_names=joint)
    cfg = SelectingCfg(resampling_time_range=(1.0, 1.0), asset_cfg=selection)
    manager = CommandManager({"goal": cfg}, env)
    return manager, manager.get_term("goal")
