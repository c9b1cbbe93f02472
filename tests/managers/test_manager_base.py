"""Base class of managers, tested on the metrics manager, and contracts of all managers."""

from __future__ import annotations

import dataclasses
import functools
import logging
import typing
from dataclasses import dataclass, field
from typing import Any, ClassVar

import pytest
import torch

from mjlab.managers import (
    ActionManager,
    ActionTermCfg,
    CommandManager,
    CommandTermCfg,
    CurriculumManager,
    CurriculumTermCfg,
    EventManager,
    EventTermCfg,
    ManagerTermBase,
    ManagerTermBaseCfg,
    MetricsManager,
    MetricsTermCfg,
    NullCommandManager,
    NullCurriculumManager,
    NullMetricsManager,
    NullRecorderManager,
    ObservationGroupCfg,
    ObservationManager,
    ObservationTermCfg,
    RecorderManager,
    RecorderTermCfg,
    RewardManager,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationManager,
    TerminationTermCfg,
)
from mjlab.utils.state import capture_state, restore_state


def value(env):
    return env.value


class Counter:
    """A class-based term that is no ManagerTermBase."""

    built: ClassVar[list] = []

    def __init__(self, cfg, env):
        self.built.append((cfg, env))
        self.calls = torch.zeros(env.num_envs)
        self.resets = []

    def __call__(self, env, step=1.0):
        self.calls += step
        return self.calls

    def reset(self, env_ids):
        self.resets.append(env_ids)
        self.calls[env_ids] = 0.0


def with_asset(env, asset_cfg):
    assert asset_cfg.joint_ids == [1]
    return env.value


MANAGERS = {
    "metrics": (MetricsManager, lambda func, **kw: MetricsTermCfg(func=func, **kw)),
    "reward": (RewardManager, lambda func, **kw: RewardTermCfg(func=func, weight=1.0, **kw)),
    "termination": (TerminationManager, lambda func, **kw: TerminationTermCfg(func=func, **kw)),
}


@pytest.fixture(params=MANAGERS)
def kind(request):
    return MANAGERS[request.param]


def test_a_class_is_built_with_cfg_and_env_and_then_called(env, kind):
    manager_class, make = kind
    Counter.built.clear()
    manager = manager_class({"count": make(Counter, params={"step": 2.0})}, env)
    cfg = manager.get_term_cfg("count")
    assert Counter.built == [(cfg, env)]
    assert isinstance(cfg.func, Counter)


def test_class_based_terms_are_reset(env, kind):
    manager_class, make = kind
    manager = manager_class({"count": make(Counter), "plain": make(value)}, env)
    ids = torch.tensor([1, 3])
    manager.reset(ids)
    assert manager.get_term_cfg("count").func.resets == [ids]


def test_configs_are_copied_and_not_changed(env, kind):
    manager_class, make = kind
    cfg = make(Counter)
    manager = manager_class({"a": cfg, "b": cfg}, env)
    assert cfg.func is Counter
    assert manager.get_term_cfg("a").func is not manager.get_term_cfg("b").func


def test_none_switches_a_term_off_and_says_so(env, kind, caplog):
    manager_class, make = kind
    with caplog.at_level(logging.INFO):
        manager = manager_class({"off": None, "on": make(value)}, env)
    assert manager.active_terms == ["on"]
    assert "'off'" in caplog.text


def test_selections_in_params_are_resolved(env, kind):
    manager_class, make = kind
    asset_cfg = SceneEntityCfg("robot", joint_names="joint_b")
    manager = manager_class({"a": make(with_asset, params={"asset_cfg": asset_cfg})}, env)
    assert manager.get_term_cfg("a").params["asset_cfg"].joint_ids == [1]
    assert asset_cfg.joint_ids == slice(None), "the caller's config must be unchanged"


@dataclasses.dataclass
class Feet:
    asset_cfg: SceneEntityCfg


def ids_of(env, selections):
    return env.value


@pytest.mark.parametrize(
    ("wrap", "unwrap"),
    [
        (lambda one: [one], lambda value: value[0]),
        (lambda one: {"left": (one,)}, lambda value: value["left"][0]),
        (lambda one: {1: one}, lambda value: value[1]),
        (Feet, lambda value: value.asset_cfg),
    ],
)
def test_selections_nested_in_params_are_resolved(env, kind, wrap, unwrap):
    manager_class, make = kind
    selection = SceneEntityCfg("robot", joint_names="joint_b")
    cfg = make(ids_of, params={"selections": wrap(selection)})
    manager = manager_class({"a": cfg}, env)
    assert unwrap(manager.get_term_cfg("a").params["selections"]).joint_ids == [1]
    assert selection.joint_ids == slice(None), "the caller's config must be unchanged"


def test_a_nested_entity_without_names_may_be_absent(env, kind):
    manager_class, make = kind
    cfg = make(ids_of, params={"selections": [SceneEntityCfg("ball")]})
    assert manager_class({"a": cfg}, env).get_term_cfg("a").params["selections"][0].name == "ball"


DEFAULT = SceneEntityCfg("robot", joint_names="joint_b")


def by_default(env, asset_cfg=DEFAULT):
    return env.value if asset_cfg.joint_ids == slice(None) else None


class ByDefault:
    def __init__(self, cfg, env):
        pass

    def __call__(self, env, *, asset_cfg=DEFAULT):
        return by_default(env, asset_cfg)


@pytest.mark.parametrize("term", [by_default, ByDefault])
def test_a_default_selection_of_elements_warns(env, kind, term):
    manager_class, make = kind
    with pytest.warns(UserWarning, match="'asset_cfg' of .*y_?[dD]efault") as caught:
        manager = manager_class({"a": make(term)}, env)
    assert len(caught) == 1
    manager.compute(**({"dt": 0.1} if manager_class is RewardManager else {}))


def test_nested_selection_without_match_warns(env, kind):
    def knees(env, cfgs):
        return env.value if cfgs["knee"].joint_ids == slice(None) else None

    manager_class, make = kind
    cfgs = {"knee": SceneEntityCfg("robot", joint_names="knee")}
    with pytest.warns(UserWarning, match=r"term 'a'.*'cfgs'.*knee") as caught:
        manager = manager_class({"a": make(knees, params={"cfgs": cfgs})}, env)
    assert len(caught) == 1
    manager.compute(**({"dt": 0.1} if manager_class is RewardManager else {}))


def test_a_selection_that_fails_names_manager_term_and_parameter(env, kind):
    manager_class, make = kind
    params = {"asset_cfg": SceneEntityCfg("robot", joint_names="knee")}
    with pytest.raises(ValueError, match=rf"{manager_class.__name__} term 'a'.*'asset_cfg'"):
        manager_class({"a": make(with_asset, params=params)}, env)
    params = {"asset_cfg": SceneEntityCfg("dog")}
    with pytest.raises(KeyError, match=r"term 'a'.*'asset_cfg'.*robot"):
        manager_class({"a": make(with_asset, params=params)}, env)


def test_a_wrong_shape_names_manager_term_and_both_shapes(env, kind):
    manager_class, make = kind
    manager = manager_class({"wide": make(lambda env: torch.zeros(4, 1))}, env)
    arguments = {"dt": 0.1} if manager_class is RewardManager else {}
    with pytest.raises(ValueError, match=rf"{manager_class.__name__}.*'wide'.*\(4,\).*\(4, 1\)"):
        manager.compute(**arguments)


def test_a_result_that_is_no_tensor_names_the_term(env, kind):
    manager_class, make = kind
    manager = manager_class({"number": make(lambda env: 1.0)}, env)
    arguments = {"dt": 0.1} if manager_class is RewardManager else {}
    with pytest.raises(ValueError, match="'number'.*1.0"):
        manager.compute(**arguments)


def test_an_unknown_term_lists_the_valid_names(env, kind):
    manager_class, make = kind
    manager = manager_class({"a": make(value)}, env)
    with pytest.raises(ValueError, match=r"'b'.*\['a'\]"):
        manager.get_term_cfg("b")


class Reads:
    def __init__(self, cfg, env):
        self.std = cfg.params["std"]

    def __call__(self, env, std, scale=1.0):
        return env.value


@pytest.mark.parametrize(
    ("term", "params", "message"),
    [
        (Counter, {"stepp": 1.0}, r"'stepp'.*step=1.0"),
        (with_asset, {}, r"missing.*'asset_cfg'"),
        (with_asset, {"asset": None}, r"'asset_cfg'"),
        (Reads, {"std": 1.0, "scal": 1.0}, r"'scal'.*scale=1.0"),
        (value, {"weight": 1.0}, r"'weight'.*\(env\)"),
        (functools.partial(with_asset, asset_cfg=None), {"env": 1}, r"'env'"),
    ],
)
def test_wrong_parameters_are_named_with_those_of_the_term(env, kind, term, params, message):
    manager_class, make = kind
    with pytest.raises(TypeError, match=rf"(?s)term 'a'.*{message}"):
        manager_class({"a": make(term, params=params)}, env)


def test_any_parameter_fits_a_term_that_takes_any(env, kind):
    manager_class, make = kind
    manager_class({"a": make(lambda env, **params: env.value, params={"any": 1})}, env)


def test_what_is_no_term_is_refused(env, kind):
    manager_class, make = kind
    with pytest.raises(TypeError, match="term 'a'.*TermCfg"):
        manager_class({"a": value}, env)
    with pytest.raises(TypeError, match="term 'a'.*'value'"):
        manager_class({"a": make("value")}, env)


def test_partial_functions_are_terms(env, kind):
    manager_class, make = kind
    manager = manager_class({"a": make(functools.partial(value))}, env)
    manager.reset(None)


def scaled(function):
    @functools.wraps(function)
    def term(env, by, **params):
        return function(env, **params) * by

    return term


def test_decorated_terms_take_their_own_parameters(env):
    cfg = RewardTermCfg(func=scaled(value), weight=1.0, params={"by": 3.0})
    manager = RewardManager({"a": cfg}, env, scale_by_dt=False)
    assert torch.equal(manager.compute(1.0), 3.0 * env.value)
    with pytest.raises(TypeError, match="term 'a'.*'by'"):
        RewardManager({"a": RewardTermCfg(func=scaled(value), weight=1.0, params={"bi": 3.0})}, env)


def test_the_printed_table_names_every_term(env):
    term = ObservationTermCfg(func=lambda env: env.value.unsqueeze(-1))
    managers = [
        MetricsManager({"speed": MetricsTermCfg(func=value)}, env),
        RewardManager({"speed": RewardTermCfg(func=value, weight=0.5)}, env),
        TerminationManager({"speed": TerminationTermCfg(func=value)}, env),
        CurriculumManager({"speed": CurriculumTermCfg(func=lambda env, env_ids: None)}, env),
        EventManager({"speed": EventTermCfg(func=lambda env, env_ids: None, mode="step")}, env),
        ObservationManager({"actor": ObservationGroupCfg({"speed": term})}, env),
    ]
    for manager in managers:
        text = str(manager)
        assert type(manager).__name__ in text
        assert "speed" in text
    assert "0.5" in str(managers[1])


@pytest.mark.parametrize(
    "manager_class",
    [
        ActionManager,
        CommandManager,
        CurriculumManager,
        EventManager,
        MetricsManager,
        ObservationManager,
        RecorderManager,
        RewardManager,
        TerminationManager,
    ],
)
def test_managers_without_terms_work(env, manager_class):
    manager = manager_class({}, env)
    assert not manager.active_terms
    assert manager.reset(torch.tensor([0])) == {}
    assert manager.get_active_iterable_terms(0) == []
    assert manager_class.__name__ in str(manager)


@pytest.mark.parametrize(
    "null_class",
    [NullCommandManager, NullCurriculumManager, NullMetricsManager, NullRecorderManager],
)
def test_null_managers_do_nothing(null_class):
    manager = null_class()
    assert manager.active_terms == []
    assert manager.cfg is None
    assert manager.get_active_iterable_terms(0) == []
    assert manager.reset(torch.tensor([0])) == {}
    assert null_class.__name__ in str(manager)


def test_null_managers_answer_what_their_kind_is_asked():
    command = NullCommandManager()
    command.compute(0.1)
    command.compute(torch.zeros(3), env_ids=torch.tensor([1]))
    assert command.get_command("a") is None
    assert command.get_term("a") is None
    assert command.get_term_cfg("a") is None
    assert command.apply_gui_reset(torch.tensor([0])) is False
    NullCurriculumManager().compute(torch.tensor([0]))
    metrics = NullMetricsManager()
    metrics.compute_substep()
    metrics.compute()
    assert metrics.needs_substep is False
    recorder = NullRecorderManager()
    recorder.record_post_step()
    recorder.close()
    assert "a" not in recorder
    with pytest.raises(KeyError, match="'a'"):
        recorder.get_term("a")


def test_state_of_terms_and_managers_survives_saving(env):
    cfg = {"count": MetricsTermCfg(func=Counter), "value": MetricsTermCfg(func=value)}
    manager, other = MetricsManager(cfg, env), MetricsManager(cfg, env)
    env.value = torch.arange(4.0)
    for _ in range(3):
        manager.compute()
    state = capture_state(manager)
    restore_state(other, state)
    for m in (manager, other):
        m.compute()
    assert other.get_term_cfg("count").func.calls.tolist() == [4.0] * 4
    logs = manager.reset(None), other.reset(None)
    assert logs[0] == logs[1]
    assert logs[0]["Episode_Metrics/value"] == 1.5


@pytest.mark.parametrize(
    "cfg_class",
    [
        ActionTermCfg,
        CommandTermCfg,
        CurriculumTermCfg,
        EventTermCfg,
        ManagerTermBaseCfg,
        MetricsTermCfg,
        ObservationGroupCfg,
        ObservationTermCfg,
        RecorderTermCfg,
        RewardTermCfg,
        SceneEntityCfg,
        TerminationTermCfg,
    ],
)
def test_the_command_line_can_read_the_types_of_config_fields(cfg_class):
    hints = typing.get_type_hints(cfg_class)
    assert {field.name for field in dataclasses.fields(cfg_class)} <= set(hints)


def test_client_configs_may_add_required_fields():
    @dataclasses.dataclass(kw_only=True)
    class MyTermCfg(RewardTermCfg):
        target: float

    cfg = MyTermCfg(value, target=2.0, weight=1.0)
    assert (cfg.func, cfg.target, cfg.weight, cfg.params) == (value, 2.0, 1.0, {})


def test_the_base_of_terms_gives_name_size_and_device(env):
    class Term(ManagerTermBase):
        pass

    term = Term(env)
    assert (term.name, term.num_envs, term.device) == ("Term", 4, "cpu")
    with pytest.raises(NotImplementedError, match="Term"):
        term()


@dataclass
class OwnRewardCfg:
    """Config class of a package, with the fields of ours."""

    func: Any
    weight: float = 2.0
    params: dict = field(default_factory=dict)


@dataclass
class OwnGroupCfg:
    terms: dict
    concatenate_terms: bool = True
    concatenate_dim: int = -1
    enable_corruption: bool = False
    history_length: int | None = None
    flatten_history_dim: bool = True
    nan_policy: str = "disabled"
    nan_check_per_term: bool = True


def test_configs_with_the_same_fields_serve(env):
    rewards: Any = {"a": OwnRewardCfg(func=lambda env: torch.ones(4))}
    assert RewardManager(rewards, env).compute(0.5).tolist() == [1.0] * 4
    term = ObservationTermCfg(func=lambda env: torch.ones(4, 2))
    groups: Any = {"g": OwnGroupCfg({"t": term})}
    assert ObservationManager(groups, env).compute()["g"].shape == (4, 2)
    assert groups["g"].terms["t"] is term
