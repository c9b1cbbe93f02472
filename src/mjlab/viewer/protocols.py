"""What viewers, environments and policies expect of each other."""

from __future__ import annotations

import enum
import inspect
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import torch

    from mjlab.envs import ManagerBasedRlEnvCfg


class VerbosityLevel(enum.IntEnum):
    """How much a viewer logs."""

    SILENT = 0
    INFO = 1
    DEBUG = 2


class EnvProtocol(Protocol):
    """What a viewer needs of an environment, or of the wrapper a policy expects around it."""

    @property
    def cfg(self) -> ManagerBasedRlEnvCfg: ...

    @property
    def device(self) -> torch.device | str: ...

    @property
    def unwrapped(self) -> Any:
        """The `ManagerBasedRlEnv` itself."""
        ...

    def get_observations(self) -> Any: ...

    def reset(self) -> Any: ...

    def step(self, actions: torch.Tensor) -> tuple[Any, ...]: ...

    def close(self) -> None: ...


class PolicyProtocol(Protocol):
    """Anything that turns observations into actions (num_envs, num_actions).

    A policy with memory also has a method `reset()`, called when the environments are reset. Where it
    is `reset(dones=None)`, it is also called after every step, with `dones` (num_envs,) not 0 where an
    episode ended.
    """

    def __call__(self, obs: torch.Tensor) -> torch.Tensor: ...


def ended(results: tuple[Any, ...]) -> torch.Tensor:
    """Return where an episode ended (num_envs,), from the four or five results of a step."""
    return results[2] if len(results) == 4 else results[2] | results[3]


def forget(policy: Any, dones: torch.Tensor) -> None:
    """Let a policy with memory forget the environments in which `dones` (num_envs,) is not 0."""
    reset = getattr(policy, "reset", None)
    try:
        knows_ends = callable(reset) and "dones" in inspect.signature(reset).parameters
    except (TypeError, ValueError):
        # Compiled functions do not say what they take.
        return
    if knows_ends:
        reset(dones)


class ViewerAction(enum.Enum):
    """What a person can ask a viewer for."""

    RESET = "reset"
    TOGGLE_PAUSE = "toggle_pause"
    SINGLE_STEP = "single_step"
    RESET_SPEED = "reset_speed"
    SPEED_UP = "speed_up"
    SPEED_DOWN = "speed_down"
    PREV_ENV = "prev_env"
    NEXT_ENV = "next_env"
    TOGGLE_PLOTS = "toggle_plots"
    TOGGLE_DEBUG_VIS = "toggle_debug_vis"
    TOGGLE_SHOW_ALL_ENVS = "toggle_show_all_envs"
    FETCH_CHECKPOINT = "fetch_checkpoint"
    CUSTOM = "custom"


@dataclass
class ViewerStatus:
    """What a status display shows."""

    paused: bool
    step_count: int
    """Environment steps since the viewer started or was last reset."""
    speed_multiplier: float
    speed_label: str
    target_realtime: float
    """Simulated seconds per wall second that were asked for."""
    actual_realtime: float
    """Simulated seconds per wall second that were reached."""
    smoothed_fps: float
    capped: bool
    """Whether the machine is too slow for the target."""
    last_error: str | None
    """Last line of the error that paused the viewer."""
