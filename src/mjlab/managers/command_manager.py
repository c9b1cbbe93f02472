"""Command manager: goals for the policy, resampled at intervals and resets."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import torch

from mjlab.compat import accept_older_methods
from mjlab.managers.debug_vis import DebugVisSwitches
from mjlab.managers.manager_base import BuiltTermsManager, ManagerTermBase, NullManager
from mjlab.managers.nonfinite import finite_mean
from mjlab.utils.errors import UnsupportedError, check_exists
from mjlab.utils.indexing import as_ids, is_empty
from mjlab.utils.lab_api.math import sample_uniform
from mjlab.utils.state import changes_undone
from mjlab.utils.tables import Table, format_shape, settings_of

if TYPE_CHECKING:
    import viser

    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.viewer.debug_visualizer import DebugVisualizer


@dataclass(kw_only=True)
class CommandTermCfg(ABC):
    """Base command term configuration. Subclasses construct the term in `build`."""

    resampling_time_range: tuple[float, float]
    """Range of the time between resamples (s)."""

    debug_vis: bool = False
    """Draw the command in viewers."""

    @abstractmethod
    def build(self, env: ManagerBasedRlEnv) -> CommandTerm:
        """Build the term."""


class CommandTerm(ManagerTermBase):
    """Base class of command terms.

    Subclasses define:

    - property `command`;
    - `_resample_command(env_ids)`: sample commands for `env_ids`;
    - optionally `_update_command(env_ids)`, called every step (None: all) and after resets;
    - optionally `_update_metrics()`: update the tensors in `self.metrics` for all environments;
    - optionally `_debug_vis_impl(visualizer)`.

    Attributes:
        time_left: Time until the next resample (s), (num_envs,).
        command_counter: Number of commands in this episode, (num_envs,) int64.
        metrics: Name to values (num_envs, ...). Resets log their means and zero them.

    Raises `ValueError` if the config's time range has min > max.
    """

    steerable: ClassVar[bool] = False
    """True if `steer` changes the command, so that viewers bind and list its keys."""

    def __init__(self, cfg: CommandTermCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(env)
        self.cfg = cfg
        low, high = cfg.resampling_time_range
        if not low <= high:
            raise ValueError(
                f"{self.name} resampling_time_range: expected shortest <= longest (s), got "
                f"{(low, high)}."
            )
        self.metrics: dict[str, torch.Tensor] = {}
        self.time_left = torch.zeros(self.num_envs, dtype=torch.float32, device=self.device)
        self.command_counter = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)

    @property
    def command(self) -> Any:
        """Current command, (num_envs, ...)."""
        raise UnsupportedError(f"{self.name} must define the property command.")

    def export_metadata(self, name: str) -> dict[str, list | str | float]:
        """Return the metadata a deployment needs to generate the command; empty by default.

        Args:
            name: Name of the command.
        """
        return {}

    def compute(self, dt: float | torch.Tensor, env_ids: torch.Tensor | None = None) -> None:
        """Advance the timers, resample expired commands, and update commands and metrics.

        Args:
            dt: Elapsed time (s): one number, or (num_envs,) if `env_ids` is None.
            env_ids: Environments to advance; the others keep time, command and metrics. None: all.
        """
        if env_ids is None:
            self._update_metrics()
            self.time_left -= dt
            due = (self.time_left <= 0.0).nonzero().flatten()
        else:
            # `_update_metrics` updates all environments. Metrics that accumulate would count a step
            # that the other environments have not made.
            with changes_undone([self], env_ids, self.num_envs, generators=False):
                self._update_metrics()
            self.time_left[env_ids] -= dt
            due = env_ids[self.time_left[env_ids] <= 0.0]
        if len(due) > 0:
            self._resample(due)
        self._update_command(env_ids)

    def reset(self, env_ids: torch.Tensor | slice | None) -> dict[str, float]:
        """Resample the commands of `env_ids`; return the mean of each metric and zero the metrics.

        The means leave out environments that `_is_measured` excludes; the mean of a metric also
        leaves out environments with a NaN or infinite value.
        """
        ids = as_ids(env_ids, self.num_envs, self.device)
        if is_empty(ids):
            return {}
        log: dict[str, float] = {}
        if self.metrics:
            metrics = [
                m if m.ndim == 1 else m.flatten(1).float().mean(1) for m in self.metrics.values()
            ]
            values = torch.stack(metrics)[:, ids].float()
            is_measured = self._is_measured(ids)
            if is_measured is not None:
                values.masked_fill_(~is_measured, torch.nan)
            log = dict(zip(self.metrics, finite_mean(values).tolist(), strict=True))
            for metric in self.metrics.values():
                metric.index_fill_(0, ids, 0.0)
        self.command_counter[ids] = 0
        self._resample(ids)
        return log

    def take_turns_from(self, episode: int) -> None:
        """Set the evaluation episodes started by the next reset of all environments.

        Environment i will run episode `episode + i`. For commands that distribute items, such as
        motions, evenly over episodes. Does nothing by default.
        """

    def debug_vis(self, visualizer: DebugVisualizer) -> None:
        """Draw the command if `cfg.debug_vis`."""
        if self.cfg.debug_vis:
            self._debug_vis_impl(visualizer)

    def create_gui(
        self,
        name: str,
        server: viser.ViserServer,
        get_env_idx: Callable[[], int],
        on_change: Callable[[], None] | None = None,
        request_action: Callable[[str, Any], None] | None = None,
    ) -> None:
        """Add the command's controls to the Viser viewer. Does nothing by default."""

    def steer(
        self,
        shares: tuple[float, float, float] | None,
        get_env_idx: Callable[[], int],
        add: bool = True,
    ) -> None:
        """Change the command of the environment in view by hand. Does nothing by default.

        Terms with `steerable` override it. Viewers call it for keys and gamepads, between steps.

        Args:
            shares: Forward and left velocity and rate of turning left, in shares of the largest. None:
                zero; if it is zero already, sampled commands again.
            get_env_idx: Returns the environment in view, which may change later.
            add: Add `shares` to the command, as keys do. Otherwise they are the command.
        """

    def on_viewer_pause(self, paused: bool) -> None:
        """Handle a pause or resume of the viewer. Does nothing by default."""

    def apply_gui_reset(self, env_ids: torch.Tensor) -> bool:
        """Write a state requested in the viewer after a reset; return True if one was written."""
        return False

    def _resample(self, env_ids: torch.Tensor) -> None:
        bounds = self.cfg.resampling_time_range
        self.time_left[env_ids] = sample_uniform(*bounds, len(env_ids), self.device)
        self._resample_command(env_ids)
        self.command_counter[env_ids] += 1

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        """Sample commands for `env_ids`, (n,) int64."""
        raise UnsupportedError(f"{self.name} must define _resample_command(env_ids).")

    def _update_command(self, env_ids: torch.Tensor | None = None) -> None:
        """Update state-dependent commands of `env_ids` (None: all)."""

    def _update_metrics(self) -> None:
        """Update the tensors in `self.metrics`."""

    def _is_measured(self, env_ids: torch.Tensor) -> torch.Tensor | None:
        """Return a mask of the `env_ids` with metrics to log, (n,) bool. None: all."""
        return None

    def _debug_vis_impl(self, visualizer: DebugVisualizer) -> None:
        """Draw the command."""


class CommandManager(DebugVisSwitches, BuiltTermsManager[CommandTerm]):
    """Command terms by name. The config is kept by reference and may be edited."""

    _title = "commands"
    _cfg_type = CommandTermCfg
    _term_type = CommandTerm

    def __init__(self, cfg: Mapping[str, CommandTermCfg | None], env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        for term in self._terms.values():
            accept_older_methods(term)

    def tables(self) -> list[Table]:
        """Return the table of the active terms."""
        columns = ("term", "type", "size", "resampling (s)", "settings")
        rows = [
            (
                name,
                type(term).__name__,
                format_shape(getattr(term.command, "shape", ())[1:]),
                term.cfg.resampling_time_range,
                settings_of(term.cfg, "resampling_time_range", "debug_vis", "viz"),
            )
            for name, term in self._terms.items()
        ]
        return [Table(self._title, columns, rows)]

    def compute(self, dt: float | torch.Tensor, env_ids: torch.Tensor | None = None) -> None:
        """Advance all commands by `dt` seconds; see `CommandTerm.compute`."""
        for term in self._terms.values():
            term.compute(dt, env_ids)

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> dict[str, Any]:
        """Reset the commands of `env_ids` (None: all) and return `Metrics/<command>/<metric>`."""
        ids = as_ids(env_ids, self.num_envs, self.device)
        log: dict[str, Any] = {}
        for name, term in self._terms.items():
            log |= {f"Metrics/{name}/{key}": value for key, value in term.reset(ids).items()}
        return log

    def get_command(self, name: str) -> torch.Tensor:
        """Return the current command. Raises `KeyError`, listing the valid names, if unknown."""
        return self.get_term(name).command

    def get_term_cfg(self, name: str) -> CommandTermCfg:
        """Return the live config of a command. Raises `ValueError` if unknown."""
        check_exists("CommandManager term", name, self._terms)
        return self._terms[name].cfg

    def get_active_iterable_terms(self, env_idx: int) -> Sequence[tuple[str, Sequence[float]]]:
        """Return the values of each command in one environment."""
        return [
            (name, term.command[env_idx].flatten().tolist()) for name, term in self._terms.items()
        ]

    def get_visualizable_terms(self) -> list[tuple[str, CommandTerm]]:
        """Return the commands with `debug_vis`, as (name, term)."""
        return [(name, term) for name, term in self._terms.items() if term.cfg.debug_vis]

    def create_gui(
        self,
        server: viser.ViserServer,
        get_env_idx: Callable[[], int],
        on_change: Callable[[], None] | None = None,
        request_action: Callable[[str, Any], None] | None = None,
    ) -> None:
        """Add the controls of all commands to the Viser viewer."""
        for name, term in self._terms.items():
            term.create_gui(name, server, get_env_idx, on_change, request_action)

    @property
    def steerable(self) -> bool:
        """True if keys of a viewer can change a command."""
        return any(term.steerable for term in self._terms.values())

    def steer(
        self,
        shares: tuple[float, float, float] | None,
        get_env_idx: Callable[[], int],
        add: bool = True,
    ) -> None:
        """Call `steer` of all commands."""
        for term in self._terms.values():
            term.steer(shares, get_env_idx, add)

    def on_viewer_pause(self, paused: bool) -> None:
        """Notify all commands of a pause or resume of the viewer."""
        for term in self._terms.values():
            term.on_viewer_pause(paused)

    def apply_gui_reset(self, env_ids: torch.Tensor) -> bool:
        """Call `apply_gui_reset` of all commands; return True if one of them wrote a state."""
        wrote = [term.apply_gui_reset(env_ids) for term in self._terms.values()]
        return any(wrote)


class NullCommandManager(NullManager, CommandManager):
    """Command manager without terms: `get_command`, `get_term` and `get_term_cfg` return None."""

    def get_command(self, name: str) -> None:  # ty: ignore
        """Return None."""

    get_term = get_term_cfg = get_command  # ty: ignore
