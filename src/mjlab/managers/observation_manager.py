"""Observations: what the policy, the critic and others see, in named groups."""

from __future__ import annotations

import copy
import dataclasses
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import torch

from mjlab.compat import offers_older_attributes
from mjlab.managers.manager_base import ManagerBase, ManagerTermBaseCfg, label_errors
from mjlab.managers.term_checks import check_real, is_interval
from mjlab.utils.buffers import CircularBuffer, DelayBuffer
from mjlab.utils.errors import WrongTypeError, check_count, check_exists, check_one_of
from mjlab.utils.indexing import is_empty
from mjlab.utils.noise import NoiseCfg, NoiseModelCfg
from mjlab.utils.random import preserved_rng
from mjlab.utils.state import capture_state, is_stateful, restore_state, stateful

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

logger = logging.getLogger(__name__)
NanPolicy = Literal["disabled", "warn", "sanitize", "error"]
Observation = torch.Tensor | dict[str, torch.Tensor]


@dataclass
class ObservationTermCfg(ManagerTermBaseCfg):
    """A term of an observation group: `func(env, **params)` returns a tensor (num_envs, ...).

    The value goes through noise, clip, scale, delay and history, in this order.
    """

    noise: NoiseCfg | NoiseModelCfg | None = None
    """Noise, or a noise model with state for each environment (a bias for each episode, say).
    Applied only in groups with `enable_corruption`."""

    clip: tuple[float, float] | None = None
    """Lower and upper bound, applied before the scale."""

    scale: tuple[float, ...] | float | torch.Tensor | None = None
    """Factor: one number, or one for each component of the last axis."""

    delay_min_lag: int = 0
    """Smallest delay, in environment steps."""

    delay_max_lag: int = 0
    """Largest delay, in environment steps; 0 means no delay."""

    delay_per_env: bool = True
    """True draws a delay for each environment, False one for all."""

    delay_hold_prob: float = 0.0
    """Probability that a delay is kept when it is due to be redrawn."""

    delay_update_period: int = 0
    """Environment steps between redraws of the delay; 0 redraws at every step."""

    delay_per_env_phase: bool = True
    """With a period: True spreads the redraws of the environments over it."""

    history_length: int = 0
    """Number of last values to return, oldest first; 0 returns the value alone. A group's
    `history_length` replaces it."""

    flatten_history_dim: bool = True
    """True returns a history of H values as (num_envs, H * size), False as (num_envs, H, ...)."""


@dataclass
class ObservationGroupCfg:
    """A named group of observation terms, such as "actor" or "critic"."""

    terms: dict[str, ObservationTermCfg | None]
    """Terms by name, in order. None switches a term off."""

    concatenate_terms: bool = True
    """True joins the terms into one tensor, False returns a dict of name to tensor."""

    concatenate_dim: int = -1
    """Dimension to join along. From 0 on it is counted without the environment dimension; negative
    values count from the end."""

    enable_corruption: bool = False
    """Whether the noise of the terms is applied."""

    history_length: int | None = None
    """If given, replaces `history_length` and `flatten_history_dim` of every term; 0 switches
    history off."""

    flatten_history_dim: bool = True
    """How terms return their history where `history_length` is given here."""

    nan_policy: NanPolicy = "disabled"
    """What to do with NaN and infinite values: nothing, warn and replace by 0, replace by 0, or
    raise."""

    nan_check_per_term: bool = True
    """True checks each term before delay and history, False the group's result."""


@offers_older_attributes
class ObservationManager(ManagerBase):
    """Computes all observation groups; groups that are None or without terms are skipped.

    Every term's function is called once while the manager is built, to learn its shape.
    """

    _transient = {"_stateful_terms"}

    def __init__(
        self, cfg: Mapping[str, ObservationGroupCfg | None], env: ManagerBasedRlEnv
    ) -> None:
        self.cfg = dict(cfg)
        for name, group in cfg.items():
            if isinstance(group, ObservationGroupCfg):
                # Each term is copied by itself, so that groups that share terms share no state.
                terms = {key: copy.deepcopy(term) for key, term in group.terms.items()}
                self.cfg[name] = dataclasses.replace(group, terms=terms)
        self._groups: dict[str, ObservationGroup] = {}
        self._obs_buffer: dict[str, Observation] | None = None
        super().__init__(env)
        terms = (term for group in self._groups.values() for term in group.terms.values())
        self._stateful_terms = [term for term in terms if term.has_state]

    @property
    def active_terms(self) -> dict[str, list[str]]:
        """Names of the terms of each group."""
        return {name: list(group.terms) for name, group in self._groups.items()}

    @property
    def group_obs_dim(self) -> dict[str, tuple[int, ...] | list[tuple[int, ...]]]:
        """For each group its shape, or the list of its terms' shapes if they are not joined.

        Shapes are without the environment dimension.
        """
        return {
            name: self.group_obs_term_dim[name] if group.shape is None else group.shape
            for name, group in self._groups.items()
        }

    @property
    def group_obs_term_dim(self) -> dict[str, list[tuple[int, ...]]]:
        """For each group the shapes of its terms, without the environment dimension."""
        return {
            name: [term.shape for term in group.terms.values()]
            for name, group in self._groups.items()
        }

    @property
    def group_obs_concatenate(self) -> dict[str, bool]:
        """For each group whether its terms are joined into one tensor."""
        return {name: group.cfg.concatenate_terms for name, group in self._groups.items()}

    def compute(
        self, update_history: bool = False, env_ids: torch.Tensor | None = None
    ) -> dict[str, Observation]:
        """Return the observation of every group, each in memory of its own.

        Args:
            update_history: Whether values enter the histories. If not, a result computed since
                the last reset is returned as it is.
            env_ids: Environments that start an episode, if only their delays and histories are to
                be filled. All environments are observed either way.

        Raises `ValueError` for `env_ids` without `update_history`.
        """
        if env_ids is not None and not update_history:
            raise ValueError(
                "ObservationManager.compute(env_ids=...) fills histories, so it needs "
                "update_history=True."
            )
        if update_history or self._obs_buffer is None:
            self._obs_buffer = {
                name: group.compute(update_history, env_ids) for name, group in self._groups.items()
            }
        return self._obs_buffer

    def preview(self) -> dict[str, Observation]:
        """Return what `compute(update_history=True)` would return.

        Delays, histories, noise models, terms that are classes, and random number generators stay
        where they are.
        """
        terms = [term for term in self._class_terms.values() if is_stateful(term)]
        parts = [*self._stateful_terms, *terms]
        before = [capture_state(part) for part in parts]
        with preserved_rng():
            previewed = {name: group.compute(True, None) for name, group in self._groups.items()}
        for part, state in zip(parts, before, strict=True):
            restore_state(part, state)
        return previewed

    def compute_group(
        self,
        group_name: str,
        update_history: bool = False,
        env_ids: torch.Tensor | None = None,
    ) -> Observation:
        """Return the observation of one group, computed now; `compute` explains the arguments.

        Raises `ValueError`, with the valid names, if there is no such group.
        """
        return self._group(group_name).compute(update_history, env_ids)

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> dict[str, float]:
        """Reset terms, delays, histories and noise models of these environments; logs nothing."""
        self._obs_buffer = None
        self._reset_class_terms(env_ids)
        if not is_empty(env_ids):
            for term in self._stateful_terms:
                term.reset(env_ids)
        return {}

    def get_term_cfg(self, group_name: str, term_name: str) -> ObservationTermCfg:
        """Return the live config of a term: noise, clip, scale and params may be changed in it.

        Raises `ValueError`, with the valid names, if there is no such group or term.
        """
        terms = self._group(group_name).terms
        check_exists(f"term of observation group {group_name!r}", term_name, terms)
        return terms[term_name].cfg

    def get_active_iterable_terms(self, env_idx: int) -> Sequence[tuple[str, Sequence[float]]]:
        """Return ("group-term", values) of the last observation for one environment."""
        observations = self.compute()
        return [
            (f"{group_name}-{term_name}", value[env_idx].flatten().tolist())
            for group_name, group in self._groups.items()
            for term_name, value in group.split(observations[group_name]).items()
        ]

    def _prepare_terms(self) -> None:
        for name, group_cfg in self._enabled(self.cfg, ObservationGroupCfg):
            label = f"Observation group {name!r}"
            check_one_of(f"{label} nan_policy", group_cfg.nan_policy, get_args(NanPolicy))
            if group_cfg.history_length is not None:
                check_count(f"{label} history_length", group_cfg.history_length, minimum=0)
            terms = {
                term_name: self._build_term(f"{name}/{term_name}", term_cfg, group_cfg)
                for term_name, term_cfg in self._enabled(group_cfg.terms, ObservationTermCfg)
            }
            if terms:
                self._groups[name] = ObservationGroup(name, group_cfg, terms)

    def _build_term(
        self, label: str, cfg: ObservationTermCfg, group_cfg: ObservationGroupCfg
    ) -> ObservationTerm:
        # Also where there is no corruption, which would hide a mistake until someone turns it on.
        if not (cfg.noise is None or isinstance(cfg.noise, NoiseCfg | NoiseModelCfg)):
            raise ValueError(
                f"Observation term {label!r} noise: expected a NoiseCfg (UniformNoiseCfg("
                f"n_min=-0.1, n_max=0.1), say), a NoiseModelCfg, or None, got {cfg.noise!r}."
            )
        if not group_cfg.enable_corruption:
            cfg.noise = None
        if group_cfg.history_length is not None:
            cfg.history_length = group_cfg.history_length
            cfg.flatten_history_dim = group_cfg.flatten_history_dim
        self._resolve_term(label, cfg, ("env",))
        policy = group_cfg.nan_policy if group_cfg.nan_check_per_term else "disabled"
        return ObservationTerm(label, cfg, self._env, policy)

    def _group(self, name: str) -> ObservationGroup:
        check_exists("observation group", name, self._groups)
        return self._groups[name]

    def _live_cfgs(self) -> dict[str, Any]:
        return {
            term.label: term.cfg for group in self._groups.values() for term in group.terms.values()
        }

    def _table(self) -> tuple[Sequence[str], Sequence[Sequence[Any]]]:
        rows = [
            (group_name, term_name, term.shape)
            for group_name, group in self._groups.items()
            for term_name, term in group.terms.items()
        ]
        return ["group", "name", "shape"], rows


@stateful
class ObservationGroup:
    """The terms of one group, and how they are joined.

    Args:
        name: Name of the group.
        cfg: Its config.
        terms: Its terms by name; at least one.

    Attributes:
        shape: Shape of the joined tensor without the environment dimension, or None for a dict.

    Raises `ValueError` if the terms cannot be joined.
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
        self.shape = self._joined_shape() if cfg.concatenate_terms else None

    def compute(
        self, update_history: bool, env_ids: torch.Tensor | None
    ) -> torch.Tensor | dict[str, torch.Tensor]:
        """Return the group's observation in memory of its own."""
        values = [term.compute(update_history, env_ids) for term in self.terms.values()]
        if self.cfg.concatenate_terms:
            # Joining copies, also a single tensor.
            return apply_nan_policy(torch.cat(values, dim=self._dim), self._nan_policy, self.name)
        return {
            name: apply_nan_policy(value.clone(), self._nan_policy, f"{self.name}/{name}")
            for name, value in zip(self.terms, values, strict=True)
        }

    def split(self, observation: torch.Tensor | dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return the parts of a result of `compute` by term."""
        if isinstance(observation, dict):
            return observation
        dim = self._axis() + 1
        parts = observation.split([term.shape[dim - 1] for term in self.terms.values()], dim=dim)
        return dict(zip(self.terms, parts, strict=True))

    def _axis(self) -> int:
        """Return the dimension to join along, counted without the environment dimension."""
        dim = self.cfg.concatenate_dim
        return dim if dim >= 0 else dim + len(next(iter(self.terms.values())).shape)

    def _joined_shape(self) -> tuple[int, ...]:
        shapes = {name: term.shape for name, term in self.terms.items()}
        first, axis = next(iter(shapes.values())), self._axis()
        for shape in shapes.values():
            others_agree = (
                len(shape) == len(first)
                and 0 <= axis < len(first)
                and shape[:axis] + shape[axis + 1 :] == first[:axis] + first[axis + 1 :]
            )
            if not others_agree:
                raise ValueError(
                    f"Observation group {self.name!r}: terms of shapes {shapes} (without the "
                    f"environment dimension) cannot be joined along concatenate_dim="
                    f"{self.cfg.concatenate_dim}. Flatten the terms, or set concatenate_terms="
                    "False."
                )
        return (*first[:axis], sum(shape[axis] for shape in shapes.values()), *first[axis + 1 :])


@stateful
class ObservationTerm:
    """The pipeline of one term, with its delay, its history and its noise model.

    Args:
        label: "group/term", for messages.
        cfg: Resolved config, owned by the manager. It is read at every call, so that a curriculum
            may change noise, clip and scale; delay and history are fixed here.
        env: The environment.
        nan_policy: What to do with NaN and infinite values before they enter delay and history.

    The term's function is called once, to learn its shape.

    Raises `ValueError`, naming the term, for a clip, scale, delay or history that makes no sense,
    and puts the term's name in front of what its function raises.

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
        if cfg.clip is not None and not is_interval(cfg.clip):
            raise ValueError(
                f"{self._name} clip: expected (low, high) with low <= high, or None, got "
                f"{cfg.clip!r}."
            )
        if cfg.scale is not None:
            cfg.scale = scale_tensor(self._name, cfg.scale, self._raw_shape, env.device)
        with label_errors(self._name):
            self._noise_model = self._build_noise_model()
            self._delay = self._build_delay()
            self._history = None
            if cfg.history_length != 0:
                self._history = CircularBuffer(cfg.history_length, env.num_envs, env.device)
        self.shape: tuple[int, ...] = tuple(self._raw_shape[1:])
        if self._history is not None:
            with_history = torch.Size((cfg.history_length, *self.shape))
            flat = (with_history.numel(),)
            self.shape = flat if cfg.flatten_history_dim else tuple(with_history)

    def compute(self, update_history: bool, env_ids: torch.Tensor | None) -> torch.Tensor:
        """Return the value (num_envs, *shape), which may be memory of the simulation.

        Args:
            update_history: Whether the value enters the history.
            env_ids: Environments that start an episode: their delay and history are filled with
                the value, those of the others stay as they are. None is a step of all.
        """
        value = self._call()
        cfg = self.cfg
        if cfg.noise is not None:
            # The noise may work in place, which must not reach the simulation.
            value = value.clone()
            if not isinstance(cfg.noise, NoiseModelCfg):
                value = cfg.noise.apply(value)
            else:
                # A curriculum may have set it.
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
        if self._delay is not None:
            if env_ids is not None and self._delay.is_initialized:
                self._delay.backfill(value, env_ids)
                value = self._delay.peek()
            else:
                self._delay.append(value)
                value = self._delay.compute()
        if self._history is not None:
            if env_ids is not None and self._history.is_initialized:
                self._history.backfill(value, env_ids)
            elif update_history or not self._history.is_initialized:
                self._history.append(value)
            frames = self._history.buffer
            value = frames.flatten(1) if cfg.flatten_history_dim else frames
        return value

    @property
    def has_state(self) -> bool:
        """Whether `reset` does anything."""
        return any(part is not None for part in (self._noise_model, self._delay, self._history))

    def reset(self, env_ids: torch.Tensor | slice | None) -> None:
        """Empty delay and history and start the noise model anew in these environments."""
        for part in (self._delay, self._history, self._noise_model):
            if part is not None:
                part.reset(env_ids)

    def _call(self) -> torch.Tensor:
        value = self.cfg.func(self._env, **self.cfg.params)
        if not isinstance(value, torch.Tensor):
            self._check_first(value)
        elif value.shape != self._raw_shape:
            raise ValueError(
                f"{self._name} returned shape {tuple(value.shape)}, but {tuple(self._raw_shape)} "
                "when the environment was built. Shapes must not change."
            )
        check_real(value, str, self._name)
        # Policies are float32, whatever the default type with which a term makes its tensors.
        return value.float() if value.dtype == torch.float64 else value

    def _check_first(self, value: Any) -> None:
        expected = f"({self._env.num_envs}, ...), with one or more dimensions after the first"
        if not isinstance(value, torch.Tensor):
            raise WrongTypeError(
                f"{self._name} must return a tensor of shape {expected}, got "
                f"{type(value).__name__}: {value!r}."
            )
        if value.ndim < 2 or value.shape[0] != self._env.num_envs:
            hint = " Add `.unsqueeze(-1)` to return one number." if value.ndim == 1 else ""
            raise ValueError(
                f"{self._name} returned shape {tuple(value.shape)}, expected {expected}.{hint}"
            )
        check_real(value, str, self._name)

    def _build_noise_model(self) -> Any:
        noise = self.cfg.noise
        if not isinstance(noise, NoiseModelCfg):
            return None
        return noise.class_type(noise, num_envs=self._env.num_envs, device=self._env.device)

    def _build_delay(self) -> DelayBuffer | None:
        cfg = self.cfg
        if cfg.delay_max_lag == 0 and cfg.delay_min_lag == 0:
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


def scale_tensor(label: str, scale: Any, raw_shape: torch.Size, device: str) -> torch.Tensor:
    """Return `scale` as a tensor that multiplies values of `raw_shape` (num_envs, ...).

    A tensor is returned as it is, anything else as float32 on `device`.

    Raises `ValueError` if it is no number or numbers, or does not fit `raw_shape`.
    """
    tensor = scale
    if not isinstance(scale, torch.Tensor):
        try:
            tensor = torch.tensor(scale, dtype=torch.float32, device=device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ValueError(
                f"{label} scale: expected one number, one for each component, or None, got "
                f"{scale!r}."
            ) from error
    try:
        # A larger result would mean that the scale stretches the observation.
        fits = torch.broadcast_shapes(tensor.shape, raw_shape) == raw_shape
    except RuntimeError:
        fits = False
    if not fits:
        raise ValueError(
            f"{label} scale: expected one number, or one for each of the {raw_shape[-1]} components "
            f"of the last axis of the term's value {tuple(raw_shape)}, got shape "
            f"{tuple(tensor.shape)}."
        )
    return tensor


def apply_nan_policy(value: torch.Tensor, policy: NanPolicy, label: str) -> torch.Tensor:
    """Return `value` (num_envs, ...) after the policy.

    "disabled" looks at nothing, "sanitize" replaces NaN and infinite numbers by 0, "warn" logs the
    environments first, and "error" raises `ValueError` with `label` and up to 10 environments.
    """
    if policy == "disabled":
        return value
    if policy != "sanitize":
        bad = ~torch.isfinite(value).flatten(1).all(dim=1)
        if not bad.any():
            return value
        ids = bad.nonzero().flatten()
        shown = ids[: 10 if policy == "error" else 5].tolist()
        message = f"Observation {label!r} is NaN or infinite in {len(ids)} environments: {shown}"
        message += " and others." if len(ids) > len(shown) else "."
        if policy == "error":
            raise ValueError(message)
        logger.warning("%s Replaced by 0.", message)
    return torch.nan_to_num(value, nan=0.0, posinf=0.0, neginf=0.0)
