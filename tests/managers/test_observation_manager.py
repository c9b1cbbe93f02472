"""Observations: the pipeline of a term, and how groups are joined."""

from __future__ import annotations

import dataclasses
import logging
from collections import deque
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.managers import (
    ManagerTermBase,
    ObservationGroupCfg,
    ObservationManager,
    ObservationTermCfg,
)
from mjlab.utils.buffers import CircularBuffer
from mjlab.utils.noise import (
    ConstantNoiseCfg,
    NoiseCfg,
    NoiseModel,
    NoiseModelCfg,
    NoiseModelWithAdditiveBiasCfg,
    UniformNoiseCfg,
)
from mjlab.utils.state import capture_state, restore_state


def state(env):
    """Memory of the simulation, as some observation terms return it."""
    return env.state


def make(env, term=None, **group):
    term = term or ObservationTermCfg(func=state)
    return ObservationManager({"g": ObservationGroupCfg({"t": term}, **group)}, env)


@pytest.fixture
def env(env):
    env.state = torch.arange(8.0).reshape(4, 2)
    return env


# The pipeline of a term.


def test_noise_then_clip_then_scale(env):
    term = ObservationTermCfg(
        func=state, noise=ConstantNoiseCfg(bias=1.0), clip=(2.0, 4.0), scale=(10.0, 100.0)
    )
    obs = make(env, term, enable_corruption=True).compute()["g"]
    expected = (env.state + 1.0).clamp(2.0, 4.0) * torch.tensor([10.0, 100.0])
    torch.testing.assert_close(obs, expected)


def test_without_corruption_there_is_no_noise_but_the_rest(env):
    noise = ConstantNoiseCfg(bias=1.0)
    term = ObservationTermCfg(func=state, noise=noise, scale=2.0)
    manager = make(env, term)
    torch.testing.assert_close(manager.compute()["g"], env.state * 2.0)
    assert manager.get_term_cfg("g", "t").noise is None
    assert term.noise is noise, "the caller's config must be unchanged"


def test_a_term_in_two_groups_is_two_terms(env):
    terms = {"t": ObservationTermCfg(func=state, noise=ConstantNoiseCfg(bias=1.0))}
    cfg = {
        "critic": ObservationGroupCfg(terms),
        "actor": ObservationGroupCfg({**terms}, enable_corruption=True),
    }
    obs = ObservationManager(cfg, env).compute()
    assert torch.equal(obs["critic"], env.state)
    assert torch.equal(obs["actor"], env.state + 1.0)


class Bias:
    """A class-based term whose instances must not be shared between groups."""

    def __init__(self, cfg, env):
        self.calls = 0

    def __call__(self, env):
        self.calls += 1
        return torch.full((env.num_envs, 1), float(self.calls))


def test_a_class_in_two_groups_is_two_instances(env):
    terms = {"t": ObservationTermCfg(func=Bias)}
    manager = ObservationManager(
        {"a": ObservationGroupCfg(terms), "b": ObservationGroupCfg(terms)}, env
    )
    obs = manager.compute()
    assert obs["a"].tolist() == obs["b"].tolist() == [[2.0]] * 4


class InPlace(NoiseModel):
    """Custom noise that modifies its input in place."""

    def __call__(self, data):
        return data.add_(1.0)


class InPlaceCfg(NoiseModelCfg, class_type=InPlace):
    pass


@pytest.mark.parametrize("concatenate", [True, False])
@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"noise": InPlaceCfg(noise_cfg=ConstantNoiseCfg())},
        {"clip": (0.0, 1.0)},
        {"scale": 2.0},
        {"delay_max_lag": 1},
        {"history_length": 2},
    ],
)
def test_observations_share_no_memory_with_the_simulation(env, fields, concatenate):
    term = ObservationTermCfg(func=state, **fields)
    manager = make(env, term, enable_corruption=True, concatenate_terms=concatenate)
    before = env.state.clone()
    obs = manager.compute(update_history=True)["g"]
    obs = obs if concatenate else obs["t"]
    assert torch.equal(env.state, before), "observing must not change the state"
    kept = obs.clone()
    env.state.fill_(77.0)
    assert torch.equal(obs, kept)
    obs.fill_(-1.0)
    assert bool((env.state == 77.0).all())


def test_an_observation_outlives_the_next_step(env):
    # Learning compares the observations of two steps.
    manager = make(env)
    first = manager.compute(update_history=True)["g"]
    kept = first.clone()
    env.state += 1.0
    manager.compute(update_history=True)
    assert torch.equal(first, kept)


def test_noise_clip_scale_and_params_can_be_changed_while_running(env):
    def shifted(env, by):
        return env.state + by

    term = ObservationTermCfg(func=shifted, params={"by": 0.0}, noise=ConstantNoiseCfg(bias=0.0))
    manager = make(env, term, enable_corruption=True)
    cfg = manager.get_term_cfg("g", "t")
    cfg.noise.bias = 1.0
    cfg.params["by"] = 1.0
    cfg.scale = 10.0
    cfg.clip = (3.0, 5.0)
    obs = manager.compute(update_history=True)["g"]
    torch.testing.assert_close(obs, (env.state + 2.0).clamp(3.0, 5.0) * 10.0)


def test_a_bias_is_kept_for_an_episode_and_does_not_wander(env):
    noise = NoiseModelWithAdditiveBiasCfg(
        noise_cfg=ConstantNoiseCfg(bias=0.0), bias_noise_cfg=UniformNoiseCfg(n_min=0.5, n_max=1.0)
    )
    manager = make(env, ObservationTermCfg(func=state, noise=noise), enable_corruption=True)
    biases = []
    for _ in range(5):
        first, second = (manager.compute(update_history=True)["g"] - env.state for _ in range(2))
        torch.testing.assert_close(first, second)
        biases.append(first)
        manager.reset(torch.tensor([0, 1]))
    for before, after in zip(biases, biases[1:], strict=False):
        assert (before[:2] != after[:2]).all(), "resampled in environments that reset"
        torch.testing.assert_close(before[2:], after[2:])
    assert all(bool(((b >= 0.5 - 1e-5) & (b <= 1.0 + 1e-5)).all()) for b in biases)


# Shapes.


def test_a_term_of_one_dimension_names_group_and_term(env):
    with pytest.raises(ValueError, match=r"'g/t'.*\(4,\).*unsqueeze"):
        make(env, ObservationTermCfg(func=lambda env: env.value))


def test_a_wrong_number_of_rows_warns(env):
    with pytest.warns(UserWarning, match=r"'g/t'.*\(4, .*got \(3, 2\)"):
        manager = make(env, ObservationTermCfg(func=lambda env: env.state[:3]))
    assert manager.compute()["g"].shape == (3, 2)


def test_a_result_that_is_no_tensor_names_group_and_term(env):
    with pytest.raises(ValueError, match=r"'g/t'.*\[1.0\]"):
        make(env, ObservationTermCfg(func=lambda env: [1.0]))


def test_a_shape_that_changes_later_is_logged(env, caplog):
    manager = make(env)
    env.state = torch.zeros(4, 3)
    for _ in range(2):
        assert manager.compute(update_history=True)["g"].shape == (4, 3)
    assert len(caplog.messages) == 1
    assert "'g/t': expected shape (4, 2), as before, got (4, 3)" in caplog.text


def test_functions_are_called_once_while_building(env):
    assert make(env, ObservationTermCfg(func=Bias)).get_term_cfg("g", "t").func.calls == 1


def image(env):
    return torch.arange(4.0 * 3 * 5 * 2).reshape(4, 3, 5, 2)


@pytest.mark.parametrize(("dim", "joined"), [(0, (6, 5, 2)), (1, (3, 10, 2)), (-1, (3, 5, 4))])
def test_terms_are_joined_along_the_dimension_given(env, dim, joined):
    terms = {name: ObservationTermCfg(func=image) for name in ("a", "b")}
    manager = ObservationManager({"g": ObservationGroupCfg(terms, True, dim)}, env)
    assert manager.group_obs_dim == {"g": joined}
    obs = manager.compute()["g"]
    assert obs.shape == (4, *joined)
    expected = torch.cat([image(env)] * 2, dim=dim + 1 if dim >= 0 else dim)
    assert torch.equal(obs, expected)
    shown = manager.get_active_iterable_terms(1)
    assert [name for name, _ in shown] == ["g-a", "g-b"]
    assert all(values == image(env)[1].flatten().tolist() for _, values in shown)


@pytest.mark.parametrize("dim", [0, 1, 2, 3, -1, -4])
def test_terms_that_cannot_be_joined_are_refused(env, dim):
    terms = {"flat": ObservationTermCfg(func=state), "image": ObservationTermCfg(func=image)}
    with pytest.raises(ValueError, match=r"'g'.*'flat': \(2,\), 'image': \(3, 5, 2\)"):
        ObservationManager({"g": ObservationGroupCfg(terms, concatenate_dim=dim)}, env)


@pytest.mark.parametrize("dim", [3, -4])
def test_the_environment_dimension_and_missing_ones_cannot_be_joined_along(env, dim):
    with pytest.raises(ValueError, match=f"concatenate_dim={dim}"):
        make(env, ObservationTermCfg(func=image), concatenate_dim=dim)


def test_groups_report_their_shapes(env):
    terms = {
        "a": ObservationTermCfg(func=state, history_length=3),
        "b": ObservationTermCfg(func=image, history_length=2, flatten_history_dim=False),
    }
    cfg = {
        "dict": ObservationGroupCfg(terms, concatenate_terms=False),
        "flat": ObservationGroupCfg({"a": terms["a"], "off": None}),
        "off": None,
        "empty": ObservationGroupCfg({"off": None}),
    }
    manager = ObservationManager(cfg, env)
    assert manager.active_terms == {"dict": ["a", "b"], "flat": ["a"]}
    assert manager.group_obs_term_dim == {"dict": [(6,), (2, 3, 5, 2)], "flat": [(6,)]}
    assert manager.group_obs_dim == {"dict": [(6,), (2, 3, 5, 2)], "flat": (6,)}
    assert manager.group_obs_concatenate == {"dict": False, "flat": True}
    obs = manager.compute()
    assert obs["dict"]["b"].shape == (4, 2, 3, 5, 2)
    assert obs["flat"].shape == (4, 6)


def test_unknown_groups_and_terms_list_the_valid_names(env):
    manager = make(env)
    with pytest.raises(ValueError, match=r"'h'.*\['g'\]"):
        manager.get_term_cfg("h", "t")
    with pytest.raises(ValueError, match=r"'g'.*'u'.*\['t'\]"):
        manager.get_term_cfg("g", "u")
    with pytest.raises(ValueError, match=r"'h'.*\['g'\]"):
        manager.compute_group("h")


# History and delay, against plain Python.


class Plain:
    """History and delay of one environment, as lists."""

    def __init__(self, history, lag):
        self.history, self.lag = history, lag
        self.seen, self.frames = [], []

    def reset(self):
        self.seen, self.frames = [], []

    def step(self, value):
        self.seen.append(value)
        delayed = self.seen[max(len(self.seen) - 1 - self.lag, 0)]
        self.frames = (self.frames or [delayed] * self.history)[1:] + [delayed]
        return self.frames


@given(
    history=st.integers(1, 4),
    lag=st.integers(0, 3),
    steps=st.lists(st.sets(st.integers(0, 2)), min_size=1, max_size=12),
    explicit=st.booleans(),
)
@settings(deadline=None, max_examples=60)
def test_history_and_delay_agree_with_plain_python(make_env, history, lag, steps, explicit):
    env = make_env(num_envs=3)
    env.state = torch.zeros(3, 2)
    term = ObservationTermCfg(
        func=state, delay_min_lag=lag, delay_max_lag=lag, history_length=history
    )
    manager = make(env, term)
    plain = [Plain(history, lag) for _ in range(3)]
    for count, resets in enumerate(steps):
        env.state = torch.stack([torch.full((3,), 1.0 + count), torch.arange(3.0)], dim=1)
        ids = torch.tensor(sorted(resets), dtype=torch.long)
        for i in resets:
            plain[i].reset()
        if len(ids) > 0:
            manager.reset(ids)
        if explicit and count > 0 and len(ids) > 0:
            # An explicit reset advances only its own environments.
            obs = manager.compute(update_history=True, env_ids=ids)["g"]
            for i in resets:
                plain[i].step(env.state[i].tolist())
        else:
            obs = manager.compute(update_history=True)["g"]
            for i in range(3):
                plain[i].step(env.state[i].tolist())
        expected = [[x for frame in p.frames for x in frame] for p in plain]
        assert obs.tolist() == expected


def test_frames_of_a_term_stay_together_oldest_first(env):
    terms = {
        "a": ObservationTermCfg(func=lambda env: env.state[:, :1]),
        "b": ObservationTermCfg(func=lambda env: env.state[:, 1:]),
    }
    manager = ObservationManager({"g": ObservationGroupCfg(terms, history_length=2)}, env)
    manager.compute(update_history=True)
    env.state = env.state + 100.0
    assert manager.compute(update_history=True)["g"][0].tolist() == [0.0, 100.0, 1.0, 101.0]


def test_a_groups_history_replaces_that_of_its_terms(env):
    term = ObservationTermCfg(func=state, history_length=5, flatten_history_dim=True)
    assert make(env, term).group_obs_dim["g"] == (10,)
    assert make(env, term, history_length=0).group_obs_dim["g"] == (2,)
    assert make(env, term, history_length=3).group_obs_dim["g"] == (6,)
    unflattened = make(env, term, history_length=3, flatten_history_dim=False)
    assert unflattened.group_obs_dim["g"] == (3, 2)
    assert unflattened.compute()["g"].shape == (4, 3, 2)
    assert unflattened.get_term_cfg("g", "t").history_length == 3
    assert term.history_length == 5


def test_lags_are_drawn_within_their_range_also_right_after_a_reset(env):
    term = ObservationTermCfg(func=state, delay_min_lag=2, delay_max_lag=3, delay_hold_prob=1.0)
    manager = make(env, term)
    for count in range(6):
        env.state = torch.full((4, 2), float(count))
        obs = manager.compute(update_history=True)["g"]
    assert set(obs.flatten().tolist()) <= {2.0, 3.0}
    manager.reset(None)
    for count in range(10, 16):
        env.state = torch.full((4, 2), float(count))
        obs = manager.compute(update_history=True)["g"]
    assert set(obs.flatten().tolist()) <= {12.0, 13.0}


def test_a_result_is_kept_until_the_next_step_or_reset(env):
    manager = make(env, ObservationTermCfg(func=state, history_length=2))
    first = manager.compute(update_history=True)
    env.state = env.state + 1.0
    assert manager.compute() is first
    assert manager.compute(update_history=True) is not first
    kept = manager.compute()
    manager.reset(torch.tensor([0]))
    assert manager.compute() is not kept


def test_only_steps_fill_an_empty_history(env):
    manager = make(env, ObservationTermCfg(func=state, history_length=2))
    manager.compute()
    env.state = env.state + 1.0
    assert manager.compute_group("g")[0].tolist() == [1.0, 2.0, 1.0, 2.0]
    env.state = env.state + 1.0
    assert manager.compute(update_history=True)["g"][0].tolist() == [2.0, 3.0, 2.0, 3.0]


# State that advances once per step.


class Tally:
    """Helper object, not marked, that counts the calls of each environment."""

    def __init__(self, num_envs):
        self.values = torch.zeros(num_envs, 1)

    def add(self):
        self.values = self.values + 1.0


class Counting(ManagerTermBase):
    """Count calls since the reset; `kind` is the place of the count."""

    def __init__(self, cfg, env):
        super().__init__(env)
        n = env.num_envs
        self.tensor = torch.zeros(n, 1)
        self.array = np.zeros((n, 1))
        self.helper = Tally(n)
        self.pair = [Tally(n), Tally(n)]
        self.numbers = [0.0] * n
        self.frames = deque([torch.zeros(n, 1)] * 3, maxlen=3)
        self.items = {"a": (torch.zeros(n, 1), Tally(n))}
        self.rings = CircularBuffer(n, n, "cpu")
        self.columns = torch.zeros(5, n, 1)

    def reset(self, env_ids=None):
        for values in (
            *(self.tensor, self.array, self.helper.values, self.pair[1].values),
            *(self.items["a"][0], self.items["a"][1].values, *self.frames),
        ):
            values[env_ids] = 0.0
        for k in range(self.num_envs)[env_ids] if isinstance(env_ids, slice) else env_ids.tolist():
            self.numbers[k] = 0.0
        self.rings.reset(env_ids)
        self.columns[:, env_ids] = 0.0

    def __call__(self, env, kind):
        if kind == "tensor":
            self.tensor += 1.0
            return self.tensor
        if kind == "array":
            self.array += 1.0
            return torch.from_numpy(self.array).float()
        if kind == "helper":
            self.helper.add()
            return self.helper.values
        if kind == "pair":
            self.pair[1].add()
            return self.pair[1].values
        if kind == "numbers":
            self.numbers = [number + 1.0 for number in self.numbers]
            return torch.tensor(self.numbers)[:, None]
        if kind == "frames":
            self.frames.append(self.frames[-1] + 1.0)
            return self.frames[-1]
        if kind == "items":
            first, second = self.items["a"]
            second.add()
            self.items["a"] = (first + 1.0, second)
            return 0.5 * (self.items["a"][0] + second.values)
        if kind == "rings":
            self.rings.append((self.rings.current_length[:, None] + 1.0).clamp(max=env.num_envs))
            return self.rings[0]
        self.columns += 1.0
        return self.columns[-1]


KINDS = ("tensor", "array", "helper", "pair", "numbers", "frames", "items", "rings", "columns")


class Drift(NoiseModel):
    """Noise that grows by one per call."""

    def __init__(self, cfg, num_envs, device):
        super().__init__(cfg, num_envs, device)
        self.bias = torch.zeros(num_envs, 1)

    def reset(self, env_ids=None):
        self.bias[slice(None) if env_ids is None else env_ids] = 0.0

    def __call__(self, data):
        self.bias += 1.0
        return data + self.bias


@dataclass(kw_only=True)
class DriftCfg(NoiseModelCfg, class_type=Drift):
    noise_cfg: NoiseCfg = field(default_factory=ConstantNoiseCfg)


def counting_terms():
    terms: dict[str, ObservationTermCfg | None] = {
        kind: ObservationTermCfg(func=Counting, params={"kind": kind}) for kind in KINDS
    }
    zeros = ObservationTermCfg(func=lambda env: torch.zeros(env.num_envs, 1), noise=DriftCfg())
    terms["drift"] = zeros
    terms["delayed"] = dataclasses.replace(zeros, delay_min_lag=1, delay_max_lag=1)
    terms["history"] = dataclasses.replace(zeros, history_length=2)
    return terms


def trace(env, concatenate, between=lambda manager, count: None):
    """Return the observations of environment 0 in four steps."""
    group = ObservationGroupCfg(
        counting_terms(), enable_corruption=True, concatenate_terms=concatenate
    )
    manager = ObservationManager({"g": group}, env)
    manager.reset()
    seen = []
    for count in range(4):
        obs = manager.compute(update_history=True)["g"]
        between(manager, count)
        parts = [obs] if concatenate else list(obs.values())
        seen.append([value for part in parts for value in part[0].tolist()])
    return seen


def reset_others(manager, count):
    if count in (0, 2):
        ids = torch.tensor([1, 3])
        before = manager.compute()["g"]
        manager.reset(ids)
        manager.compute()
        manager.compute_group("g")
        after = manager.compute(update_history=True, env_ids=ids)["g"]
        for old, new in zip(
            *(o.values() if isinstance(o, dict) else [o] for o in (before, after)), strict=True
        ):
            assert torch.equal(old[0], new[0])


SIDE_PATHS = {
    "compute_group": lambda manager, _: manager.compute_group("g"),
    "viewer": lambda manager, _: manager.get_active_iterable_terms(0),
    "preview": lambda manager, _: manager.preview(),
    "partial reset": reset_others,
    "nothing to reset": lambda manager, _: manager.compute(
        True, torch.tensor([], dtype=torch.long)
    ),
}


@pytest.mark.parametrize("concatenate", [True, False])
@pytest.mark.parametrize("path", SIDE_PATHS)
def test_side_paths_advance_no_other_state(env, path, concatenate):
    assert trace(env, concatenate, SIDE_PATHS[path]) == trace(env, concatenate)


def test_every_kind_of_state_advances_per_step(env):
    steps = trace(env, True)
    plain = len(KINDS)
    assert [step[:plain] for step in steps] == [[k] * plain for k in (1.0, 2.0, 3.0, 4.0)]
    assert [step[plain:] for step in steps] == [
        [1.0, 1.0, 1.0, 1.0],
        [2.0, 1.0, 1.0, 2.0],
        [3.0, 2.0, 2.0, 3.0],
        [4.0, 3.0, 3.0, 4.0],
    ]


@pytest.mark.parametrize("ids", [[2], [2, 2, 2, 2]])
def test_a_partial_reset_starts_the_state_of_its_rows(env, ids):
    group = ObservationGroupCfg(counting_terms(), enable_corruption=True)
    manager = ObservationManager({"g": group}, env)
    manager.reset()
    for _ in range(3):
        manager.compute(update_history=True)
    ids = torch.tensor(ids)
    manager.reset(ids)
    assert set(manager.compute(update_history=True, env_ids=ids)["g"][2].tolist()) == {1.0}
    obs = manager.compute(update_history=True)["g"]
    assert obs[2, : len(KINDS)].tolist() == [2.0] * len(KINDS)
    assert obs[0, : len(KINDS)].tolist() == [4.0] * len(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_compute_group_shows_the_last_values(env, kind):
    manager = make(env, ObservationTermCfg(func=Counting, params={"kind": kind}))
    manager.reset()
    for _ in range(2):
        manager.compute(update_history=True)
    assert manager.compute_group("g").tolist() == [[2.0]] * 4


def test_terms_with_slots_run(env):
    class Slots:
        __slots__ = ("scale",)

        def __init__(self, cfg, env):
            self.scale = 2.0

        def __call__(self, env):
            return self.scale * env.state

    manager = make(env, ObservationTermCfg(func=Slots))
    manager.reset()
    assert torch.equal(manager.compute(update_history=True)["g"], 2.0 * env.state)
    manager.reset(torch.tensor([1]))
    assert torch.equal(manager.compute_group("g"), 2.0 * env.state)
    capture_state(manager)


def test_differences_stay_in_other_rows(env):
    class Rate(ManagerTermBase):
        def __init__(self, cfg, env):
            super().__init__(env)
            self.last = torch.zeros(env.num_envs, 1)

        def reset(self, env_ids=None):
            self.last[env_ids] = 0.0

        def __call__(self, env):
            now = env.state[:, :1].clone()
            rate, self.last = now - self.last, now
            return rate

    env.state = torch.zeros_like(env.state)
    manager = make(env, ObservationTermCfg(func=Rate))
    manager.reset()
    manager.compute(update_history=True)
    env.state = env.state + 2.0
    manager.compute(update_history=True)
    ids = torch.tensor([1])
    manager.reset(ids)
    assert manager.compute(update_history=True, env_ids=ids)["g"].tolist() == [[2.0]] * 4
    assert manager.compute_group("g").tolist() == [[2.0]] * 4
    assert manager.compute(update_history=True)["g"].tolist() == [[0.0]] * 4


def test_counters_do_not_count_partial_resets(env):
    class Clock(ManagerTermBase):
        def __init__(self, cfg, env):
            super().__init__(env)
            self.count = 0

        def __call__(self, env):
            self.count += 1
            return torch.full((env.num_envs, 1), float(self.count))

    manager = make(env, ObservationTermCfg(func=Clock))
    first = manager.compute(update_history=True)["g"][0].item()
    manager.compute(update_history=True, env_ids=torch.tensor([1]))
    assert manager.compute(update_history=True)["g"][0].item() == first + 1.0
    manager.compute(update_history=True, env_ids=torch.arange(4))
    assert manager.compute(update_history=True)["g"][0].item() == first + 3.0


def test_side_paths_keep_random_numbers(env):
    class Random(ManagerTermBase):
        def __init__(self, cfg, env):
            super().__init__(env)
            self.torch = torch.Generator().manual_seed(1)

        def __call__(self, env):
            draws = torch.rand(env.num_envs, 1, generator=self.torch)
            return draws + torch.rand(env.num_envs, 1)

    def draws(between):
        torch.manual_seed(0)
        noise = UniformNoiseCfg()
        terms = {"t": ObservationTermCfg(func=Random, noise=noise, delay_max_lag=3)}
        manager = ObservationManager(
            {"g": ObservationGroupCfg({**terms}, enable_corruption=True)}, env
        )
        manager.reset()
        values = []
        for _ in range(4):
            between(manager)
            values.append(manager.compute(update_history=True)["g"])
            between(manager)
        return torch.cat(values, dim=1)

    expected = draws(lambda manager: None)
    assert torch.equal(draws(lambda manager: manager.compute_group("g")), expected)
    assert torch.equal(draws(lambda manager: manager.compute()), expected)


def test_other_rows_show_current_values_of_stateless_terms(env):
    manager = make(env)
    manager.compute(update_history=True)
    env.state = env.state + 5.0
    ids = torch.tensor([1])
    manager.reset(ids)
    assert torch.equal(manager.compute(update_history=True, env_ids=ids)["g"], env.state)


def test_filling_histories_of_some_needs_update_history(env):
    with pytest.raises(ValueError, match="update_history=True"):
        make(env).compute(env_ids=torch.tensor([0]))


def test_a_delay_out_of_range_names_the_term(env):
    with pytest.raises(ValueError, match="'g/t'"):
        make(env, ObservationTermCfg(func=state, delay_min_lag=2, delay_max_lag=1))


def test_a_minimum_lag_alone_is_no_delay(env):
    with pytest.warns(UserWarning, match="'g/t' delay_max_lag"):
        manager = make(env, ObservationTermCfg(func=state, delay_min_lag=2))
    manager.compute(update_history=True)
    env.state = env.state + 1.0
    assert torch.equal(manager.compute(update_history=True)["g"], env.state)


@pytest.mark.parametrize("owner", ["group", "term"])
def test_a_negative_history_is_none(env, owner):
    length = {"history_length": -1}
    term = ObservationTermCfg(func=state, **(length if owner == "term" else {}))
    manager = make(env, term, **(length if owner == "group" else {}))
    assert torch.equal(manager.compute(update_history=True)["g"], env.state)


@pytest.mark.parametrize("per_term", [True, False])
def test_an_unknown_nan_policy_sanitizes(env, per_term):
    expected = spoiled(env)
    manager = make(env, nan_policy="ignore", nan_check_per_term=per_term)
    assert torch.equal(manager.compute()["g"], expected)


# NaN.


def spoiled(env):
    env.state = torch.tensor([[1.0, 2.0], [torch.nan, 3.0], [torch.inf, 4.0], [-torch.inf, 5.0]])
    return torch.tensor([[1.0, 2.0], [0.0, 3.0], [0.0, 4.0], [0.0, 5.0]])


@pytest.mark.parametrize("per_term", [True, False])
@pytest.mark.parametrize("concatenate", [True, False])
@pytest.mark.parametrize("policy", ["warn", "sanitize"])
def test_nan_and_infinity_become_zero(env, policy, concatenate, per_term, caplog):
    manager = make(
        env, concatenate_terms=concatenate, nan_policy=policy, nan_check_per_term=per_term
    )
    expected = spoiled(env)
    with caplog.at_level(logging.WARNING):
        obs = manager.compute(update_history=True)["g"]
    assert torch.equal(obs if concatenate else obs["t"], expected)
    assert ("3 environments: [1, 2, 3]" in caplog.text) == (policy == "warn")


@pytest.mark.parametrize(("per_term", "label"), [(True, "'g/t'"), (False, "'g'")])
def test_the_error_policy_names_term_and_environments(env, per_term, label):
    manager = make(env, nan_policy="error", nan_check_per_term=per_term)
    manager.compute(update_history=True)
    spoiled(env)
    with pytest.raises(ValueError, match=rf"{label}.*\[1, 2, 3\]"):
        manager.compute(update_history=True)


def test_the_disabled_policy_passes_nan_on(env):
    manager = make(env)
    spoiled(env)
    assert manager.compute(update_history=True)["g"].isnan().any()


def test_a_check_per_term_keeps_the_history_clean(env):
    manager = make(env, nan_policy="sanitize", history_length=2)
    clean = spoiled(env)
    manager.compute(update_history=True)
    env.state = torch.ones(4, 2)
    assert torch.equal(manager.compute(update_history=True)["g"][:, :2], clean)


def test_saved_state_continues_as_if_nothing_had_happened(env):
    noise = NoiseModelWithAdditiveBiasCfg(
        noise_cfg=ConstantNoiseCfg(bias=0.0), bias_noise_cfg=UniformNoiseCfg(n_min=0.5, n_max=1.0)
    )
    term = ObservationTermCfg(func=state, noise=noise, delay_max_lag=2, history_length=3)
    manager, other = (make(env, term, enable_corruption=True) for _ in range(2))
    for m in (manager, other):
        m.compute(update_history=True)
    for _ in range(4):
        env.state = torch.rand(4, 2)
        manager.compute(update_history=True)
    saved = capture_state(manager)
    restore_state(other, saved)
    rng = torch.get_rng_state()
    wanted = manager.compute(update_history=True)["g"]
    torch.set_rng_state(rng)
    assert torch.equal(other.compute(update_history=True)["g"], wanted)


# Errors when a term is built.


@pytest.mark.parametrize(
    "scale",
    [(1.0, 2.0, 3.0), torch.ones(3), torch.ones(1, 4, 2), (), ((1.0,), (2.0,))],
)
def test_a_scale_that_does_not_fit_is_refused(env, scale):
    with pytest.raises(ValueError, match="'g/t' scale"):
        make(env, ObservationTermCfg(func=state, scale=scale))


@pytest.mark.parametrize("scale", [2.0, (2.0,), (2.0, 2.0), torch.tensor(2.0), torch.full((2,), 2)])
def test_a_scale_is_one_number_or_one_for_each_component(env, scale):
    manager = make(env, ObservationTermCfg(func=state, scale=scale))
    torch.testing.assert_close(manager.compute()["g"], 2.0 * env.state)


def test_a_scale_that_is_replaced_later_is_checked_too(env):
    manager = make(env)
    manager.get_term_cfg("g", "t").scale = (1.0, 2.0, 3.0)
    with pytest.raises(ValueError, match=r"'g/t' scale.*\(3,\)"):
        manager.compute(update_history=True)


@pytest.mark.parametrize("clip", [(1.0,), 1.0, "01"])
def test_a_clip_is_a_pair(env, clip):
    with pytest.raises((TypeError, ValueError), match="'g/t'"):
        make(env, ObservationTermCfg(func=state, clip=clip))


@pytest.mark.parametrize("clip", [(1.0, -1.0), (float("nan"), 1.0)])
def test_an_odd_clip_is_that_of_torch(env, clip):
    with pytest.warns(UserWarning, match=r"'g/t' clip.*\(low, high\)"):
        manager = make(env, ObservationTermCfg(func=state, clip=clip))
    expected = env.state.clamp(*clip[:2])
    torch.testing.assert_close(manager.compute()["g"], expected, equal_nan=True)


def test_a_clip_may_be_open_on_one_side_or_a_point(env):
    for clip in ((-float("inf"), 3.0), (3.0, float("inf")), (1, 1), (None, 3.0), [3.0, None]):
        obs = make(env, ObservationTermCfg(func=state, clip=clip)).compute()["g"]
        torch.testing.assert_close(obs, env.state.clamp(*clip))


@pytest.mark.parametrize("corruption", [False, True])
@pytest.mark.parametrize("noise", [0.1, UniformNoiseCfg, (-0.1, 0.1)])
def test_other_noise_warns_and_has_no_effect(env, noise, corruption):
    with pytest.warns(UserWarning, match="'g/t' noise.*UniformNoiseCfg"):
        manager = make(
            env, ObservationTermCfg(func=state, noise=noise), enable_corruption=corruption
        )
    assert torch.equal(manager.compute()["g"], env.state)


class SpecialError(ValueError):
    """Cannot be made from a message alone."""

    def __init__(self, code, reason):
        super().__init__(code, reason)


@pytest.mark.parametrize(
    ("error", "kind", "message"),
    [
        (ValueError("no contact"), ValueError, "'g/t': no contact"),
        (KeyError("no robot"), KeyError, "'g/t': no robot"),
        (SpecialError(3, "odd"), ValueError, r"'g/t': \(3, 'odd'\)"),
    ],
)
def test_errors_of_the_first_call_and_of_the_constructor_name_the_term(env, error, kind, message):
    def call(env):
        raise error

    class Term:
        def __init__(self, cfg, env):
            raise error

    for func, label in ((call, "Observation term"), (Term, "ObservationManager term")):
        with pytest.raises(kind, match=f"{label} {message}") as caught:
            make(env, ObservationTermCfg(func=func))
        assert type(caught.value) is kind
        assert caught.value.__cause__ is error


def test_errors_of_other_kinds_pass_unchanged(env):
    def call(env):
        raise ZeroDivisionError("unchanged")

    with pytest.raises(ZeroDivisionError, match="^unchanged$"):
        make(env, ObservationTermCfg(func=call))
