"""Observation manager: named groups of terms (actor, critic, ...) with noise, delay and history."""

from __future__ import annotations

import copy
import logging
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import torch

from mjlab.compat import offers_older_attributes
from mjlab.managers.manager_base import ManagerBase, ManagerTermBaseCfg, label_errors
from mjlab.utils.buffers import CircularBuffer, DelayBuffer
from mjlab.utils.errors import check_exists
from mjlab.utils.indexing import as_ids, is_empty
from mjlab.utils.memory import check_memory
from mjlab.utils.noise import NoiseCfg, NoiseModelCfg
from mjlab.utils.random import preserved_rng
from mjlab.utils.spaces import Box, Dict, Space, batch_space
from mjlab.utils.state import (
    capture_state,
    changes_undone,
    is_stateful,
    mark_stateful,
    stateful,
)
from mjlab.utils.string import counted
from mjlab.utils.tables import Table, format_shape, function_name

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

logger = logging.getLogger(__name__)
NanPolicy = Literal["disabled", "warn", "sanitize", "error"]
Observation = torch.Tensor | dict[str, torch.Tensor]


@dataclass
class ObservationTermCfg(ManagerTermBaseCfg):
    """Observation term configuration: `func(env, **params)` returns a tensor (num_envs, ...).

    Pipeline: noise, clip, scale, delay, history.
    """

    noise: NoiseCfg | NoiseModelCfg | None = None
    """Noise, or a noise model with per-environment state (e.g. a bias per episode). Applied only in
    groups with `enable_corruption`."""

    clip: tuple[float, float] | None = None
    """Lower and upper bound, applied before the scale."""

    scale: tuple[float, ...] | float | torch.Tensor | None = None
    """Factor: one number, or one per component of the last axis."""

    delay_min_lag: int = 0
    """Minimum lag (environment steps)."""

    delay_max_lag: int = 0
    """Maximum lag (environment steps). 0: no delay."""

    delay_per_env: bool = True
    """Sample per-environment lags. False: one lag for all environments."""

    delay_hold_prob: float = 0.0
    """Probability of keeping the lag when it is due for resampling."""

    delay_update_period: int = 0
    """Environment steps between resamples of the lag. 0: every step."""

    delay_per_env_phase: bool = True
    """Stagger resampling across environments over `delay_update_period`."""

    history_length: int = 0
    """Number of past values to return, oldest first (histories of contact sensors are newest first).
    0: the current value only. Replaced by the group's `history_length`."""

    flatten_history_dim: bool = True
    """Return a history of H values as (num_envs, H * size) instead of (num_envs, H, ...)."""


@dataclass
class ObservationGroupCfg:
    """Configuration of a named group of observation terms, such as "actor" or "critic"."""

    terms: dict[str, ObservationTermCfg]
    """Terms by name, in order. None disables a term."""

    concatenate_terms: bool = True
    """Concatenate the terms into one tensor. False: return a dict of name to tensor."""

    concatenate_dim: int = -1
    """Dimension of concatenation. Values >= 0 do not count the environment dimension; negative
    values count from the end."""

    enable_corruption: bool = False
    """Apply the noise of the terms."""

    history_length: int | None = None
    """Replacement of `history_length` and `flatten_history_dim` of every term. 0: no history.
    None: settings of the terms."""

    flatten_history_dim: bool = True
    """Flatten the histories of the terms. Used only with the group's `history_length`."""

    nan_policy: NanPolicy = "disabled"
    """Handling of NaN and infinite values: `disabled`, `warn` (and replace by 0), `sanitize`
    (replace by 0), or `error`."""

    nan_check_per_term: bool = True
    """Apply `nan_policy` per term before delay and history. False: to the group's result."""


@offers_older_attributes
class ObservationManager(ManagerBase):
    """Computes all observation groups. Groups that are None or have no terms are skipped.

    Every term function is called once during construction, to infer its shape.

    Only `compute` and `compute_group` with `update_history` advance state: delays, histories, noise
    models, class-based terms, and random numbers.
    """

    _title = "observations"

    def __init__(
        self, cfg: Mapping[str, ObservationGroupCfg | None], env: ManagerBasedRlEnv
    ) -> None:
        self.cfg = dict(cfg)
        for name, group in cfg.items():
            if hasattr(group, "terms"):
                # One copy per term: groups that share a term config must not share state.
                self.cfg[name] = group = copy.copy(group)
                group.terms = {key: copy.deepcopy(term) for key, term in group.terms.items()}
        self._groups: dict[str, ObservationGroup] = {}
        self._obs_buffer: dict[str, Observation] = {}
        # False after a reset, until the next observation.
        self._is_current = False
        super().__init__(env)

    def tables(self) -> list[Table]:
        """Return the table of the active terms; `noise` is None in groups without corruption."""
        columns = (
            *("group", "term", "size", "noise", "clip", "scale", "delay", "history"),
            *("function", "parameters"),
        )
        rows = [
            (group_name, term_name, *term.describe())
            for group_name, group in self._groups.items()
            for term_name, term in group.terms.items()
        ]
        sizes = {
            name: f"{len(group.terms)} tensors"
            if group.shape is None
            else format_shape(group.shape)
            for name, group in self._groups.items()
        }
        note = ", ".join(f"{name} {size}" for name, size in sizes.items())
        return [Table(self._title, columns, rows, note=note)]

    @property
    def active_terms(self) -> dict[str, list[str]]:
        """Names of the terms of each group."""
        return {name: list(group.terms) for name, group in self._groups.items()}

    @property
    def group_obs_dim(self) -> dict[str, tuple[int, ...] | list[tuple[int, ...]]]:
        """Shape of each group, or the list of its terms' shapes if they are not concatenated.

        Shapes do not include the environment dimension.
        """
        return {
            name: self.group_obs_term_dim[name] if group.shape is None else group.shape
            for name, group in self._groups.items()
        }

    @property
    def group_obs_term_dim(self) -> dict[str, list[tuple[int, ...]]]:
        """Shapes of the terms of each group, without the environment dimension."""
        return {
            name: [term.shape for term in group.terms.values()]
            for name, group in self._groups.items()
        }

    @property
    def group_obs_concatenate(self) -> dict[str, bool]:
        """True for each group whose terms are concatenated into one tensor."""
        return {name: group.cfg.concatenate_terms for name, group in self._groups.items()}

    @property
    def single_space(self) -> Dict:
        """Space of the observations of one environment; groups that are dicts by term are `Dict`."""
        groups: dict[str, Space] = {}
        for name, group in self._groups.items():
            boxes: dict[str, Space] = {key: Box(t.shape) for key, t in group.terms.items()}
            groups[name] = Dict(spaces=boxes) if group.shape is None else Box(group.shape)
        return Dict(spaces=groups)

    @property
    def space(self) -> Space:
        """Space of the observations of all environments."""
        return batch_space(self.single_space, self.num_envs)

    def compute(
        self, update_history: bool = False, env_ids: torch.Tensor | None = None
    ) -> dict[str, Observation]:
        """Return the observation of every group as a new tensor.

        Args:
            update_history: Advance the state of the terms by one step. If False, a result computed
                since the last reset is returned unchanged.
            env_ids: Environments that start an episode: only their state advances.

        Environments that do not advance show the last values of terms with state, and current
        values of other terms.

        Raises `ValueError` for `env_ids` without `update_history`.
        """
        if env_ids is not None and not update_history:
            raise ValueError(
                "ObservationManager.compute env_ids: expected update_history=True, because env_ids "
                "fills histories, got False."
            )
        if self._is_current and not update_history:
            return self._obs_buffer
        computed = self._compute(self._groups, update_history, env_ids)
        if update_history:
            self._obs_buffer, self._is_current = computed, True
        return computed

    def preview(self) -> dict[str, Observation]:
        """Return the result of `compute(update_history=True)` without side effects."""
        terms = _terms(self._groups)
        parts = [part for term in terms for part in term.stateful_parts()]
        with preserved_rng(), changes_undone([*terms, *parts]):
            return {name: group.compute(True, None) for name, group in self._groups.items()}

    def compute_group(
        self,
        group_name: str,
        update_history: bool = False,
        env_ids: torch.Tensor | None = None,
    ) -> Observation:
        """Compute and return the observation of one group. Arguments as in `compute`.

        Raises `ValueError`, listing the valid names, if the group is unknown.
        """
        check_exists("observation group", group_name, self._groups)
        groups = {group_name: self._groups[group_name]}
        return self._compute(groups, update_history, env_ids)[group_name]

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> dict[str, float]:
        """Reset terms, delays, histories and noise models of `env_ids` (None: all). Logs nothing."""
        self._is_current = False
        super().reset(env_ids)
        if not is_empty(env_ids):
            for term in _terms(self._groups):
                term.reset(env_ids)
        return {}

    def get_term_cfg(self, group_name: str, term_name: str) -> ObservationTermCfg:
        """Return the live config of a term. Its noise, clip, scale and params may be edited.

        Raises `ValueError`, listing the valid names, if the group or term is unknown.
        """
        check_exists("observation group", group_name, self._groups)
        terms = self._groups[group_name].terms
        check_exists(f"term of observation group {group_name!r}", term_name, terms)
        return terms[term_name].cfg

    def get_active_iterable_terms(self, env_idx: int) -> Sequence[tuple[str, Sequence[float]]]:
        """Return ("group-term", values) of the last observation of one environment."""
        observations = self.compute()
        return [
            (f"{group_name}-{term_name}", value[env_idx].flatten().tolist())
            for group_name, group in self._groups.items()
            for term_name, value in group.split(observations[group_name]).items()
        ]

    def _compute(
        self,
        groups: Mapping[str, ObservationGroup],
        update_history: bool,
        env_ids: torch.Tensor | None,
    ) -> dict[str, Observation]:
        """Compute groups. Arguments as in `compute`, but the last result is not reused as a whole."""
        ids = None if env_ids is None else as_ids(env_ids, self.num_envs, self.device)
        all_advance = update_history and (ids is None or len(ids.unique()) == self.num_envs)
        if all_advance:
            return {name: group.compute(True, ids) for name, group in groups.items()}
        terms = _terms(groups)
        parts = [part for term in terms for part in term.stateful_parts()]
        if update_history:
            # Delays and histories fill only rows `ids` by themselves.
            with changes_undone(parts, ids, self.num_envs, generators=False):
                computed = {name: group.compute(True, ids) for name, group in groups.items()}
        else:
            with preserved_rng(), changes_undone([*parts, *terms]):
                computed = {name: group.compute(False, None) for name, group in groups.items()}
        if update_history or self._is_current:
            others = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
            if ids is not None:
                others[ids] = False
            self._copy_last(groups, computed, others)
        return computed

    def _copy_last(
        self,
        groups: Mapping[str, ObservationGroup],
        computed: dict[str, Observation],
        rows: torch.Tensor,
    ) -> None:
        """Copy the last values of terms with state into `computed`, in environments `rows` (a mask).

        A new value would depend on the time since the last call: differences would be zero.
        """
        for name in groups.keys() & self._obs_buffer.keys():
            now, last = (groups[name].split(obs[name]) for obs in (computed, self._obs_buffer))
            for key, term in groups[name].terms.items():
                if any(capture_state(part) for part in term.stateful_parts()):
                    now[key][rows] = last[key][rows]

    def _prepare_terms(self) -> None:
        for name, group_cfg in self._enabled(self.cfg, ObservationGroupCfg):
            terms = {
                term_name: self._build_term(f"{name}/{term_name}", term_cfg, group_cfg)
                for term_name, term_cfg in self._enabled(group_cfg.terms, ObservationTermCfg)
            }
            if terms:
                self._groups[name] = ObservationGroup(name, group_cfg, terms)
                self._live_cfgs |= {term.label: term.cfg for term in terms.values()}

    def _build_term(
        self, label: str, cfg: ObservationTermCfg, group_cfg: ObservationGroupCfg
    ) -> ObservationTerm:
        # Checked even without corruption: the mistake would surface only once it is enabled.
        if not (cfg.noise is None or isinstance(cfg.noise, NoiseCfg | NoiseModelCfg)):
            _warn(
                f"Observation term {label!r} noise: expected a NoiseCfg (e.g. UniformNoiseCfg("
                f"n_min=-0.1, n_max=0.1)), a NoiseModelCfg, or None, got {cfg.noise!r}; no noise applies."
            )
            cfg.noise = None
        if not group_cfg.enable_corruption:
            cfg.noise = None
        if group_cfg.history_length is not None:
            cfg.history_length = group_cfg.history_length
            cfg.flatten_history_dim = group_cfg.flatten_history_dim
        self._resolve_term(label, cfg, ("env",))
        policy = group_cfg.nan_policy if group_cfg.nan_check_per_term else "disabled"
        return ObservationTerm(label, cfg, self._env, policy)


@stateful
class ObservationGroup:
    """Observation group: its terms and their concatenation.

    Args:
        name: Name of the group.
        cfg: Config of the group.
        terms: Terms by name; at least one.

    Attributes:
        shape: Shape of the concatenated tensor without the environment dimension. None: a dict.

    Raises `ValueError` if the terms cannot be concatenated.
    """

    _transient = {"name", "shape", "_dim", "_nan_policy"}

    def __init__(
        self, name: str, cfg: ObservationGroupCfg, terms: dict[str, ObservationTerm]
    ) -> None:
        self.name = name
        self.cfg = cfg
        self.terms = terms
        dim = cfg.concatenate_dim
        self._dim = dim + 1 if dim >= 0 else dim
        self._nan_policy: NanPolicy = "disabled" if cfg.nan_check_per_term else cfg.nan_policy
        self.shape: tuple[int, ...] | None = None
        if cfg.concatenate_terms:
            shapes = {key: term.shape for key, term in terms.items()}
            try:
                parts = [torch.empty(shape) for shape in shapes.values()]
                self.shape = tuple(torch.cat(parts, dim=dim).shape)
            except (IndexError, RuntimeError) as error:
                raise ValueError(
                    f"Observation group {name!r}: expected shapes that concatenate along "
                    f"concatenate_dim={dim}, got {shapes} (without the environment dimension); "
                    "flatten the terms, or set concatenate_terms=False."
                ) from error

    def compute(
        self, update_history: bool, env_ids: torch.Tensor | None
    ) -> torch.Tensor | dict[str, torch.Tensor]:
        """Return the group's observation as a new tensor."""
        values = [term.compute(update_history, env_ids) for term in self.terms.values()]
        if self.cfg.concatenate_terms:
            # `cat` copies even a single tensor.
            return apply_nan_policy(torch.cat(values, dim=self._dim), self._nan_policy, self.name)
        return {
            name: apply_nan_policy(value.clone(), self._nan_policy, f"{self.name}/{name}")
            for name, value in zip(self.terms, values, strict=True)
        }

    def split(self, observation: torch.Tensor | dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Split a result of `compute` by term."""
        if isinstance(observation, dict):
            return observation
        sizes = [term.shape[self.cfg.concatenate_dim] for term in self.terms.values()]
        parts = observation.split(sizes, dim=self._dim)
        return dict(zip(self.terms, parts, strict=True))


@stateful
class ObservationTerm:
    """Pipeline of one observation term: noise, clip, scale, delay, history.

    Args:
        label: "group/term", for messages.
        cfg: Resolved config, owned by the manager. Noise, clip and scale are read at every call, so
            that curricula may change them; delay and history are fixed at construction.
        env: The environment.
        nan_policy: Handling of NaN and infinite values before they enter delay and history.

    The term's function is called once, to infer its shape.

    Raises `ValueError`, naming the term, for an invalid scale or delay, and prefixes errors of the
    term's function with the term's name.

    Attributes:
        shape: Shape of the result without the environment dimension.
    """

    _transient = {"label", "shape", "_name", "_nan_policy"}

    def __init__(
        self,
        label: str,
        cfg: ObservationTermCfg,
        env: ManagerBasedRlEnv,
        nan_policy: NanPolicy = "disabled",
    ) -> None:
        self.label, self._name = label, f"Observation term {label!r}"
        self.cfg = cfg
        self._env = env
        self._nan_policy: NanPolicy = nan_policy
        with label_errors(self._name):
            value = cfg.func(env, **cfg.params)
        self._check_first(value)
        self._raw_shape = value.shape
        with label_errors(self._name):
            low, high = (None, None) if cfg.clip is None else cfg.clip[:2]
            bounded = low is not None and high is not None
            if bounded and not bool((torch.as_tensor(low) <= high).all()):
                _warn(
                    f"{self._name} clip: expected (low, high) with low <= high, got {cfg.clip!r}."
                )
            if cfg.scale is not None:
                cfg.scale = scale_tensor(self._name, cfg.scale, self._raw_shape, env.device)
            self._noise_model = self._build_noise_model()
            self._delay = self._build_delay()
            self._history = None
            if cfg.history_length > 0:
                check_memory(
                    "history_length", cfg.history_length, 4 * self._raw_shape.numel(), env.device,
                    "a shorter history",
                )  # fmt: skip
                self._history = CircularBuffer(cfg.history_length, env.num_envs, env.device)
        self.shape: tuple[int, ...] = tuple(self._raw_shape[1:])
        if self._history is not None:
            with_history = torch.Size((cfg.history_length, *self.shape))
            flat = (with_history.numel(),)
            self.shape = flat if cfg.flatten_history_dim else tuple(with_history)

    def compute(self, update_history: bool, env_ids: torch.Tensor | None) -> torch.Tensor:
        """Return the value, (num_envs, *shape); it may be a view of simulation memory.

        Args:
            update_history: Append the value to delay and history. If False, it only fills those of
                environments without a value since their reset.
            env_ids: Environments that start an episode: their delay and history are filled with
                the value; other environments keep theirs. None: a step of all environments.
        """
        cfg = self.cfg
        value = cfg.func(self._env, **cfg.params)
        if value.shape != self._raw_shape:
            self._check_shape(value)
        if value.dtype == torch.float64:
            # Policies are float32, whatever torch's default dtype.
            value = value.float()
        if cfg.noise is not None:
            # In-place noise must not change simulation memory.
            value = value.clone()
            if not isinstance(cfg.noise, NoiseModelCfg):
                value = cfg.noise.apply(value)
            else:
                # A curriculum may have set the noise after construction.
                if self._noise_model is None:
                    self._noise_model = self._build_noise_model()
                value = self._noise_model(value)
        if cfg.clip is not None:
            value = torch.clamp(value, cfg.clip[0], cfg.clip[1])
        if cfg.scale is not None:
            if not isinstance(cfg.scale, torch.Tensor):
                cfg.scale = scale_tensor(self._name, cfg.scale, self._raw_shape, self._env.device)
            value = value * cfg.scale
        if self._nan_policy != "disabled":
            value = apply_nan_policy(value, self._nan_policy, self.label)
        is_step = update_history and env_ids is None
        if self._delay is not None:
            if is_step or not self._delay.is_initialized:
                self._delay.append(value)
                value = self._delay.compute()
            else:
                _backfill(self._delay, value, env_ids)
                value = self._delay.peek()
        if self._history is not None:
            if is_step or not self._history.is_initialized:
                self._history.append(value)
            else:
                _backfill(self._history, value, env_ids)
            frames = self._history.buffer
            value = frames.flatten(1) if cfg.flatten_history_dim else frames
        return value

    def describe(self) -> tuple[Any, ...]:
        """Return size, noise, clip, scale, delay, history, function and parameters."""
        cfg = self.cfg
        lags = (cfg.delay_min_lag, cfg.delay_max_lag)
        return (
            format_shape(self.shape),
            cfg.noise,
            cfg.clip,
            cfg.scale,
            lags if self._delay is not None else None,
            cfg.history_length or None,
            function_name(cfg.func),
            cfg.params,
        )

    def reset(self, env_ids: torch.Tensor | slice | None) -> None:
        """Clear delay and history and reset the noise model of `env_ids` (None: all)."""
        for part in (self._delay, self._history, self._noise_model):
            if part is not None:
                part.reset(env_ids)

    def stateful_parts(self) -> list[Any]:
        """Return the objects that a call may change, except for delay and history."""
        return [part for part in (self.cfg.func, self._noise_model) if is_stateful(part)]

    def _check_shape(self, value: torch.Tensor) -> None:
        """Warn of a shape that is not that of the first call."""
        logger.warning(
            "%s: expected shape %s, as before, got %s.",
            *(self._name, tuple(self._raw_shape), tuple(value.shape)),
        )
        self._raw_shape = value.shape

    def _check_first(self, value: Any) -> None:
        expected = f"({self._env.num_envs}, ...), with one or more dimensions after the first"
        shape = getattr(value, "shape", ())
        if len(shape) < 2:
            hint = "; use `.unsqueeze(-1)` for one number" if len(shape) == 1 else ""
            raise ValueError(
                f"{self._name}: expected a tensor of shape {expected}, got "
                f"{tuple(shape) or repr(value)}{hint}."
            )
        if shape[0] != self._env.num_envs:
            _warn(f"{self._name}: expected shape {expected}, got {tuple(shape)}.")

    def _build_noise_model(self) -> Any:
        noise = self.cfg.noise
        if not isinstance(noise, NoiseModelCfg):
            return None
        model = noise.class_type(noise, num_envs=self._env.num_envs, device=self._env.device)
        mark_stateful(model, self._env.num_envs)
        return model

    def _build_delay(self) -> DelayBuffer | None:
        cfg = self.cfg
        if cfg.delay_max_lag <= 0:
            if cfg.delay_min_lag > 0:
                _warn(
                    f"{self._name} delay_max_lag: expected an integer >= delay_min_lag="
                    f"{cfg.delay_min_lag}, got {cfg.delay_max_lag}; no delay applies."
                )
            return None
        return DelayBuffer(
            min_lag=cfg.delay_min_lag,
            max_lag=cfg.delay_max_lag,
            batch_size=self._env.num_envs,
            device=self._env.device,
            per_env=cfg.delay_per_env,
            hold_prob=cfg.delay_hold_prob,
            update_period=cfg.delay_update_period,
            per_env_phase=cfg.delay_per_env_phase,
        )


def _warn(message: str) -> None:
    warnings.warn(message, UserWarning, stacklevel=3)


def _backfill(
    buffer: DelayBuffer | CircularBuffer, value: torch.Tensor, env_ids: torch.Tensor | None
) -> None:
    """Fill rows `env_ids` with `value`. None: rows without a value since their reset."""
    ids = buffer.empty_rows.nonzero().flatten() if env_ids is None else env_ids
    buffer.backfill(value, ids)


def _terms(groups: Mapping[str, ObservationGroup]) -> list[ObservationTerm]:
    return [term for group in groups.values() for term in group.terms.values()]


def scale_tensor(name: str, scale: Any, raw_shape: torch.Size, device: str) -> torch.Tensor:
    """Return `scale` as a tensor that multiplies values of `raw_shape` (num_envs, ...).

    Tensors are returned unchanged, other values as float32 on `device`.

    Raises `ValueError` if `scale` does not broadcast to `raw_shape`.
    """
    is_tensor = isinstance(scale, torch.Tensor)
    tensor = scale if is_tensor else torch.tensor(scale, dtype=torch.float32, device=device)
    try:
        # The scale must not expand the observation.
        tensor.expand(raw_shape)
    except RuntimeError as error:
        raise ValueError(
            f"{name} scale: expected one number, or one for each of the {raw_shape[-1]} components "
            f"of the last axis of the term's value {tuple(raw_shape)}, got shape "
            f"{tuple(tensor.shape)}."
        ) from error
    return tensor


def apply_nan_policy(value: torch.Tensor, policy: NanPolicy, name: str) -> torch.Tensor:
    """Return `value`, (num_envs, ...), after applying a NaN policy.

    "disabled" checks nothing, "sanitize" replaces NaN and infinite values by 0, "warn" (and any other
    word) also logs the environments, and "error" raises `ValueError` with `name` and up to 10 environments.
    """
    if policy == "disabled":
        return value
    if policy != "sanitize":
        bad = ~torch.isfinite(value).flatten(1).all(dim=1)
        if not bad.any():
            return value
        ids = bad.nonzero().flatten()
        shown = ids[: 10 if policy == "error" else 5].tolist()
        message = f"Observation {name!r} is NaN or infinite in {counted(len(ids), 'environment')}: {shown}"
        message += " and others." if len(ids) > len(shown) else "."
        if policy == "error":
            raise ValueError(message)
        logger.warning("%s Replaced by 0.", message)
    return torch.nan_to_num(value, nan=0.0, posinf=0.0, neginf=0.0)
