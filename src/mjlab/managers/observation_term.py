"""One observation term: from what its function returns to what the policy sees."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from mjlab.managers.error_labels import errors_named
from mjlab.managers.manager_base import ManagerTermBaseCfg
from mjlab.managers.nan_policy import NanPolicy, apply_nan_policy
from mjlab.managers.observation_checks import check_clip, scale_tensor
from mjlab.managers.real_values import check_real
from mjlab.utils.buffers import CircularBuffer, DelayBuffer
from mjlab.utils.noise import NoiseCfg, NoiseModelCfg
from mjlab.utils.state import stateful

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


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

    _transient = {"label", "shape", "_nan_policy"}

    def __init__(
        self,
        label: str,
        cfg: ObservationTermCfg,
        env: ManagerBasedRlEnv,
        nan_policy: NanPolicy = "disabled",
    ) -> None:
        self.label = label
        self.cfg = cfg
        self._env = env
        self._nan_policy: NanPolicy = nan_policy
        self._raw_shape = self._first_shape()
        check_clip(label, cfg.clip)
        if cfg.scale is not None:
            cfg.scale = scale_tensor(label, cfg.scale, self._raw_shape, env.device)
        with errors_named(self._name):
            self._noise_model = self._build_noise_model()
            self._delay = self._build_delay()
            self._history = self._build_history()
        self.shape = self._result_shape(tuple(self._raw_shape[1:]))

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
            value = self._with_noise(value.clone(), cfg.noise)
        if cfg.clip is not None:
            value = torch.clamp(value, cfg.clip[0], cfg.clip[1])
        scale = self._scale_as_tensor()
        if scale is not None:
            value = value * scale
        if self._nan_policy != "disabled":
            value = apply_nan_policy(value, self._nan_policy, self.label)
        if self._delay is not None:
            value = self._delayed(self._delay, value, env_ids)
        if self._history is not None:
            value = self._with_history(self._history, value, update_history, env_ids)
        return value

    @property
    def has_state(self) -> bool:
        """Whether `reset` does anything."""
        return any(part is not None for part in (self._noise_model, self._delay, self._history))

    def reset(self, env_ids: torch.Tensor | slice | None) -> None:
        """Empty delay and history and start the noise model anew in these environments."""
        if self._delay is not None:
            self._delay.reset(env_ids)
        if self._history is not None:
            self._history.reset(env_ids)
        if self._noise_model is not None:
            self._noise_model.reset(env_ids)

    def _call(self) -> torch.Tensor:
        value = self.cfg.func(self._env, **self.cfg.params)
        if not isinstance(value, torch.Tensor):
            self._check_first(value)
        elif value.shape != self._raw_shape:
            raise ValueError(
                f"Observation term {self.label!r} returned shape {tuple(value.shape)}, but "
                f"{tuple(self._raw_shape)} when the environment was built. Shapes must not change."
            )
        else:
            check_real(f"Observation term {self.label!r}", value)
        # Policies are float32, whatever the default type with which a term makes its tensors.
        return value.float() if value.dtype == torch.float64 else value

    def _check_first(self, value: Any) -> None:
        expected = f"({self._env.num_envs}, ...), with one or more dimensions after the first"
        if not isinstance(value, torch.Tensor):
            raise TypeError(
                f"Observation term {self.label!r} must return a tensor of shape {expected}, got "
                f"{type(value).__name__}: {value!r}."
            )
        if value.ndim < 2 or value.shape[0] != self._env.num_envs:
            hint = " Add `.unsqueeze(-1)` to return one number." if value.ndim == 1 else ""
            raise ValueError(
                f"Observation term {self.label!r} returned shape {tuple(value.shape)}, expected "
                f"{expected}.{hint}"
            )
        check_real(f"Observation term {self.label!r}", value)

    def _with_noise(self, value: torch.Tensor, noise: NoiseCfg | NoiseModelCfg) -> torch.Tensor:
        if isinstance(noise, NoiseModelCfg):
            if self._noise_model is None:
                self._noise_model = self._build_noise_model()
            return self._noise_model(value)
        return noise.apply(value)

    def _scale_as_tensor(self) -> torch.Tensor | None:
        """Keep the scale as a float tensor on the device, also after someone has replaced it."""
        scale = self.cfg.scale
        if scale is not None and not isinstance(scale, torch.Tensor):
            scale = scale_tensor(self.label, scale, self._raw_shape, self._env.device)
            self.cfg.scale = scale
        return scale

    def _delayed(
        self, delay: DelayBuffer, value: torch.Tensor, env_ids: torch.Tensor | None
    ) -> torch.Tensor:
        if env_ids is not None and delay.is_initialized:
            delay.backfill(value, env_ids)
            return delay.peek()
        delay.append(value)
        return delay.compute()

    def _with_history(
        self,
        history: CircularBuffer,
        value: torch.Tensor,
        update_history: bool,
        env_ids: torch.Tensor | None,
    ) -> torch.Tensor:
        if env_ids is not None and history.is_initialized:
            history.backfill(value, env_ids)
        elif update_history or not history.is_initialized:
            history.append(value)
        frames = history.buffer
        return frames.flatten(1) if self.cfg.flatten_history_dim else frames

    # Building.

    @property
    def _name(self) -> str:
        return f"Observation term {self.label!r}"

    def _first_shape(self) -> torch.Size:
        with errors_named(self._name):
            value = self.cfg.func(self._env, **self.cfg.params)
        self._check_first(value)
        return value.shape

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

    def _build_history(self) -> CircularBuffer | None:
        length = self.cfg.history_length
        if length == 0:
            return None
        return CircularBuffer(length, self._env.num_envs, self._env.device)

    def _result_shape(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        if self._history is None:
            return shape
        with_history = (self.cfg.history_length, *shape)
        if not self.cfg.flatten_history_dim:
            return with_history
        return (int(torch.Size(with_history).numel()),)
