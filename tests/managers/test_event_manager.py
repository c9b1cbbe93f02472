"""Events: when they happen, for whom, and what is recomputed after them."""

from __future__ import annotations

import warnings

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.managers import EventManager, EventTermCfg, SceneEntityCfg
from mjlab.managers.event_manager import RecomputeLevel, requires_model_fields


class Calls:
    """Event that records the environments of its calls."""

    def __init__(self):
        self.ids = []

    def __call__(self, env, env_ids):
        self.ids.append(env_ids.tolist() if isinstance(env_ids, torch.Tensor) else env_ids)


def make(env, mode, **fields):
    manager = EventManager({"a": EventTermCfg(func=Calls(), mode=mode, **fields)}, env)
    return manager, manager.get_term_cfg("a").func.ids


def test_startup_and_step_events_are_for_all_environments(env):
    manager, calls = make(env, "startup")
    manager.apply("startup")
    assert calls == [None]
    manager, calls = make(env, "step")
    manager.apply("step", dt=0.02)
    assert calls == [None]


def test_other_modes_do_not_fire(env):
    manager, calls = make(env, "step")
    manager.apply("startup")
    manager.apply("interval", dt=0.02)
    manager.apply("reset", env_ids=torch.tensor([0]), global_env_step_count=0)
    assert calls == []


def test_an_unknown_mode_never_happens(env):
    with pytest.warns(UserWarning, match=r"'a'.*startup.*reset.*interval.*step.*'rest'"):
        manager, calls = make(env, "rest")
    for mode in ("startup", "step", "interval"):
        manager.apply(mode, dt=0.02)
    manager.reset(None)
    assert calls == []
    with pytest.raises(ValueError, match="'rest'"):
        manager.apply("rest")


def test_modes_with_events_are_listed(env):
    cfg = {
        "a": EventTermCfg(func=Calls(), mode="reset"),
        "b": EventTermCfg(func=Calls(), mode="step"),
        "c": EventTermCfg(func=Calls(), mode="reset"),
    }
    manager = EventManager(cfg, env)
    assert manager.available_modes == ["reset", "step"]
    assert manager.active_terms == {"reset": ["a", "c"], "step": ["b"]}


@given(
    low=st.integers(1, 5),
    extra=st.integers(0, 5),
    resets=st.lists(st.booleans(), min_size=1, max_size=30),
)
@settings(deadline=None, max_examples=40)
def test_timers_count_down_fire_and_are_redrawn(make_env, low, extra, resets):
    manager, calls = make(
        make_env(), "interval", interval_range_s=(0.02 * low, 0.02 * (low + extra))
    )
    # Steps since the last event or reset, kept in plain Python.
    waited = [0] * 4
    for reset in resets:
        calls.clear()
        manager.apply("interval", dt=0.02)
        fired = calls[0] if calls else []
        waited = [w + 1 for w in waited]
        for i in fired:
            assert low <= waited[i] <= low + extra + 1
            waited[i] = 0
        assert all(w <= low + extra for w in waited), "an event is overdue"
        if reset:
            manager.reset(torch.tensor([1, 3]))
            waited[1] = waited[3] = 0


def test_an_interval_of_whole_steps_is_not_off_by_one(env):
    manager, calls = make(env, "interval", interval_range_s=(0.14, 0.14))
    for step in range(1, 22):
        manager.apply("interval", dt=0.02)
        assert len(calls) == step // 7


def test_no_call_where_no_timer_is_over(env):
    manager, calls = make(env, "interval", interval_range_s=(1.0, 1.0))
    manager.apply("interval", dt=0.02)
    assert calls == []


def test_a_global_timer_is_one_for_all_and_ignores_resets(env):
    manager, calls = make(env, "interval", interval_range_s=(0.1, 0.1), is_global_time=True)
    for step in range(1, 11):
        manager.reset(None)
        manager.apply("interval", dt=0.02)
        assert calls == [None] * (step // 5)


@given(m=st.integers(0, 5), steps=st.lists(st.integers(0, 4), min_size=1, max_size=15))
@settings(deadline=None, max_examples=40)
def test_reset_events_wait_as_long_as_they_must(make_env, m, steps):
    manager, calls = make(make_env(), "reset", min_step_count_between_reset=m)
    last = {}
    count = 0
    for step in steps:
        count += step
        ids = [count % 4, (count + 1) % 4]
        calls.clear()
        manager.apply("reset", env_ids=torch.tensor(ids), global_env_step_count=count)
        due = [i for i in ids if i not in last or count - last[i] >= m]
        assert calls == ([due] if due else [])
        last |= dict.fromkeys(due, count)


@pytest.mark.parametrize(
    ("mode", "arguments", "message"),
    [
        ("interval", {}, "dt"),
        ("step", {}, "dt"),
        ("interval", {"dt": 0.1, "env_ids": torch.tensor([0])}, "env_ids"),
        ("reset", {"env_ids": torch.tensor([0])}, "global_env_step_count"),
        ("reset", {"global_env_step_count": 1}, "env_ids"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(env, mode, arguments, message):
    manager, _ = make(env, "startup")
    with pytest.raises(ValueError, match=rf"'{mode}'.*{message}"):
        manager.apply(mode, **arguments)


def test_intervals_need_a_range(env):
    with pytest.raises(ValueError, match="'a'.*interval_range_s"):
        make(env, "interval", interval_range_s=None)


@pytest.mark.parametrize(
    ("bounds", "steps"),
    [((0.2, 0.1), {5, 6, 7, 8, 9, 10}), ((-1.0, -0.5), {1}), ((float("nan"), 1.0), {None})],
)
def test_an_odd_interval_warns_and_acts_as_sampled(env, bounds, steps):
    with pytest.warns(UserWarning, match="'a'.*interval_range_s"):
        manager, calls = make(env, "interval", interval_range_s=bounds)
    fired = dict.fromkeys(range(4))
    for step in range(1, 12):
        del calls[:]
        manager.apply("interval", dt=0.02)
        fired |= {i: step for ids in calls for i in ids if fired[i] is None}
    assert set(fired.values()) <= steps


def test_an_interval_of_another_mode_is_not_read(env):
    manager, calls = make(env, "step", interval_range_s=(2.0, 1.0))
    manager.apply("step", dt=0.02)
    assert calls == [None]


def changing(level, *fields):
    return requires_model_fields(*fields, recompute=level)(lambda env, env_ids: None)


@given(st.lists(st.sampled_from(list(RecomputeLevel)), max_size=4))
@settings(deadline=None, max_examples=40)
def test_levels_of_fired_events_are_joined_and_recomputed_once(make_env, levels):
    env = make_env()
    cfg = {
        str(i): EventTermCfg(func=changing(level), mode="startup") for i, level in enumerate(levels)
    }
    EventManager(cfg, env).apply("startup")
    fixed = {RecomputeLevel.set_const_fixed, RecomputeLevel.set_const} & set(levels)
    at_qpos0 = {RecomputeLevel.set_const_0, RecomputeLevel.set_const} & set(levels)
    expected = {
        (False, False): [],
        (True, False): [RecomputeLevel.set_const_fixed],
        (False, True): [RecomputeLevel.set_const_0],
        (True, True): [RecomputeLevel.set_const],
    }
    assert env.sim.recomputed == expected[bool(fixed), bool(at_qpos0)]


def test_after_a_reset_constants_are_recomputed_where_it_was(make_env):
    env = make_env()
    mass = changing(RecomputeLevel.set_const, "body_mass")
    events = {mode: EventTermCfg(func=mass, mode=mode) for mode in ("startup", "reset")}
    manager = EventManager(events, env)
    manager.apply("startup")
    manager.apply("reset", env_ids=torch.tensor([1]), global_env_step_count=0)
    everywhere, where_reset = env.sim.recomputed_for
    assert everywhere is None
    assert where_reset.tolist() == [1]


def test_events_that_did_not_fire_recompute_nothing(env):
    cfg = EventTermCfg(
        func=changing(RecomputeLevel.set_const), mode="interval", interval_range_s=(1.0, 1.0)
    )
    EventManager({"a": cfg}, env).apply("interval", dt=0.02)
    assert env.sim.recomputed == []


def test_fields_that_events_change_are_listed_with_what_derives_from_them(env):
    cfg = {
        "mass": EventTermCfg(func=changing(RecomputeLevel.set_const, "body_mass"), mode="startup"),
        "damping": EventTermCfg(
            func=changing(RecomputeLevel.none, "dof_damping", "body_mass"), mode="reset"
        ),
        "plain": EventTermCfg(func=Calls(), mode="step"),
    }
    assert EventManager(cfg, env).domain_randomization_fields == (
        "body_mass",
        "body_subtreemass",
        "dof_invweight0",
        "body_invweight0",
        "tendon_length0",
        "tendon_invweight0",
        "actuator_acc0",
        "dof_damping",
    )


def test_classes_declare_model_fields_too(env):
    @requires_model_fields("geom_friction", recompute=RecomputeLevel.set_const_fixed)
    class Friction:
        def __init__(self, cfg, env):
            pass

        def __call__(self, env, env_ids):
            pass

    manager = EventManager({"a": EventTermCfg(func=Friction, mode="startup")}, env)
    assert manager.domain_randomization_fields == ("geom_friction", "body_subtreemass")
    manager.apply("startup")
    assert env.sim.recomputed == [RecomputeLevel.set_const_fixed]


def test_the_field_of_older_releases_is_accepted():
    with pytest.warns(FutureWarning, match="domain_randomization"):
        cfg = EventTermCfg(func=Calls(), mode="startup", domain_randomization=True)
    assert cfg.mode == "startup"


class Stateful(Calls):
    def __init__(self, cfg, env):
        super().__init__()
        self.drawn = 0

    def reset(self, env_ids):
        self.ids.append("reset")

    def debug_vis(self, visualizer):
        self.drawn += 1


def test_terms_of_all_modes_are_reset_and_may_draw(env):
    cfg = {
        "a": EventTermCfg(func=Stateful, mode="startup"),
        "b": EventTermCfg(func=Stateful, mode="step"),
        "c": EventTermCfg(func=Calls(), mode="step"),
    }
    manager = EventManager(cfg, env)
    assert manager.reset(torch.tensor([0])) == {}
    manager.debug_vis(None)
    for name in "ab":
        assert manager.get_term_cfg(name).func.ids == ["reset"]
        assert manager.get_term_cfg(name).func.drawn == 1
    assert manager.get_term_cfg("c").func.ids == []


@pytest.mark.parametrize("empty", [{"geom_names": ()}, {"geom_ids": []}])
def test_selections_left_empty_warn(env, empty):
    params = {"asset_cfg": SceneEntityCfg("robot", **empty)}
    event = EventTermCfg(func=lambda env, env_ids, asset_cfg: None, mode="startup", params=params)
    with pytest.warns(UserWarning, match="'friction', .*'asset_cfg': expected geom_names"):
        EventManager({"friction": event}, env)


def test_selections_of_all_or_some_do_not_warn(env):
    selections = (SceneEntityCfg("robot"), SceneEntityCfg("robot", geom_names=("geom_a",)))
    for asset_cfg in selections:
        event = EventTermCfg(
            func=lambda env, env_ids, asset_cfg: None,
            mode="startup",
            params={"asset_cfg": asset_cfg},
        )
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            EventManager({"friction": event}, env)
