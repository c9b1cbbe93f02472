"""Base class of interactive viewers: pacing, pausing, actions and errors.

`BaseViewer` runs the loop with a display, `run_headless` without one. The protocols of environments
and policies precede them; timing (`RealtimePacer`, `RateMeter`) and the recent values of terms
(`TermHistory`) follow.
"""

from __future__ import annotations

import contextlib
import enum
import inspect
import logging
import math
import queue
import signal
import time
import traceback
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
import torch

from mjlab.compat import older_names
from mjlab.utils.signals import handled_signals
from mjlab.utils.string import counted
from mjlab.utils.tracebacks import users_lines

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnvCfg

log = logging.getLogger(__name__)

SPEEDS = tuple(2.0**exponent for exponent in range(-5, 4))
"""Default selectable speeds, as multiples of real time: 1/32, 1/16, ... 8."""

# Bounds of the sleep between ticks. The upper bound keeps buttons responsive.
_MAX_SLEEP_S = 0.005
_MIN_SLEEP_S = 0.0005

_STATS_WINDOW_S = 0.5


class VerbosityLevel(enum.IntEnum):
    """Verbosity of a viewer's log."""

    SILENT = 0
    INFO = 1
    DEBUG = 2


class EnvProtocol(Protocol):
    """Environment, or wrapper that the policy expects around it, as a viewer uses it."""

    @property
    def cfg(self) -> ManagerBasedRlEnvCfg: ...

    @property
    def device(self) -> torch.device | str: ...

    @property
    def unwrapped(self) -> Any:
        """Unwrapped `ManagerBasedRlEnv`."""
        ...

    def get_observations(self) -> Any: ...

    def reset(self) -> Any: ...

    def step(self, actions: torch.Tensor) -> tuple[Any, ...]: ...

    def close(self) -> None: ...


class PolicyProtocol(Protocol):
    """Callable that maps observations to actions (num_envs, num_actions).

    A recurrent policy also has a method `reset()`, called when the environments are reset. With the
    signature `reset(dones=None)`, it is also called after every step, with `dones` (num_envs,)
    nonzero for episodes that ended.
    """

    def __call__(self, obs: torch.Tensor) -> torch.Tensor: ...


class ViewerAction(enum.Enum):
    """Viewer commands."""

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
    STEER = "steer"
    """Change the command of the robot in view. Payload: that of `BaseViewer.steer`."""
    CUSTOM = "custom"


class Steering(enum.Enum):
    """Directions of steering; values are (forward, left, turn left), in shares of the largest command."""

    FORWARD = (0.1, 0.0, 0.0)
    BACKWARD = (-0.1, 0.0, 0.0)
    LEFT = (0.0, 0.1, 0.0)
    RIGHT = (0.0, -0.1, 0.0)
    TURN_LEFT = (0.0, 0.0, 0.1)
    TURN_RIGHT = (0.0, 0.0, -0.1)
    STOP = None
    """Stop; a stopped robot gets sampled commands again."""


@dataclass
class ViewerStatus:
    """Values of a status display."""

    paused: bool
    step_count: int
    """Environment steps since the viewer started or was last reset."""
    speed_multiplier: float
    speed_label: str
    target_realtime: float
    """Target of simulated seconds per wall second."""
    actual_realtime: float
    """Measured simulated seconds per wall second."""
    smoothed_fps: float
    capped: bool
    """True if the machine is too slow for the target."""
    last_error: str | None
    """Last line of the error that paused the viewer."""


class BaseViewer(ABC):
    """Viewer that steps an environment with a policy in real time; subclasses display it.

    Only the thread that calls `run` accesses the environment. Callbacks of buttons and keys run
    in other threads and queue actions (`request_action`).
    """

    SPEED_MULTIPLIERS: ClassVar[list[float]] = list(SPEEDS)
    """Selectable speeds, as multiples of real time, in ascending order."""

    def __init__(
        self,
        env: EnvProtocol,
        policy: PolicyProtocol,
        frame_rate: float = 30.0,
        verbosity: int = VerbosityLevel.SILENT,
    ) -> None:
        """Create an unpaused viewer at real-time speed.

        Args:
            env: Environment or wrapper whose observations `policy` takes.
            policy: Maps observations to actions.
            frame_rate: Displayed frames per second of wall time.
            verbosity: Log verbosity, a `VerbosityLevel`.
        """
        self.env = env
        self.policy = policy
        self.frame_rate = frame_rate
        self.frame_time = 1.0 / frame_rate
        self.verbosity = VerbosityLevel(verbosity)
        self.cfg = env.unwrapped.cfg.viewer
        self._pacer = RealtimePacer(
            float(env.unwrapped.step_dt), self.frame_time, self.SPEED_MULTIPLIERS
        )
        self._actions: queue.SimpleQueue[tuple[ViewerAction, Any]] = queue.SimpleQueue()
        self._paused = False
        self._step_count = 0
        self._total_steps = 0
        self._last_error: str | None = None
        self._interrupted = False
        self._step_limit = math.inf
        now = time.perf_counter()
        self._rates = RateMeter(now)
        self._last_tick = now
        self._next_frame = now

    # Hooks of subclasses.

    @abstractmethod
    def setup(self) -> None:
        """Open the window or page."""

    @abstractmethod
    def is_running(self) -> bool:
        """Return True until the window or page is closed."""

    @abstractmethod
    def sync_env_to_viewer(self) -> None:
        """Show the current state of the environment; called once per displayed frame."""

    @abstractmethod
    def sync_viewer_to_env(self) -> None:
        """Apply user input, e.g. a push with the mouse, to the environment."""

    @abstractmethod
    def close(self) -> None:
        """Close the window or page. Repeated calls have no effect."""

    def after_env_step(self) -> None:  # noqa: B027, optional
        """Called right after every environment step."""

    def after_reset(self) -> None:  # noqa: B027, optional
        """Called after the environments are reset."""

    def on_paused(self, paused: bool) -> None:  # noqa: B027, optional
        """Called when the viewer is paused or resumed."""

    def handle_action(self, action: ViewerAction, payload: Any) -> bool:
        """Handle an action that `BaseViewer` does not; return False if it is unknown."""
        return False

    def env_in_view(self) -> int:
        """Return the index of the environment in view, the one that keys steer."""
        return 0

    # Loop.

    def run(self, num_steps: int | None = None, catch_sigint: bool = True) -> None:
        """Run the viewer until the user closes it or a limit is reached, then close it.

        Args:
            num_steps: Number of environment steps to take. None: unlimited.
            catch_sigint: Let the first Ctrl+C end the loop and the second one the program.
        """
        self._interrupted = False
        self._step_limit = math.inf if num_steps is None else self._total_steps + num_steps

        def interrupt(*_: Any) -> None:
            # The second Ctrl+C ends the program.
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            self._interrupted = True

        with handled_signals(interrupt, [signal.SIGINT] if catch_sigint else []):
            try:
                self.setup()
                self._last_tick = self._next_frame = time.perf_counter()
                self._rates.restart(self._last_tick)
                while self.is_running() and not self._should_stop():
                    if not self.tick():
                        due = self._next_frame - time.perf_counter()
                        if not self._paused:
                            due = min(due, self._pacer.time_to_next_step)
                        time.sleep(min(max(due, _MIN_SLEEP_S), _MAX_SLEEP_S))
            finally:
                self.close()

    def tick(self) -> bool:
        """Process due actions, environment steps and frame; return True if a frame was shown."""
        now = time.perf_counter()
        elapsed, self._last_tick = now - self._last_tick, now
        self._process_actions()
        if not self._paused:
            self._pacer.add(elapsed)
            deadline = time.perf_counter() + self.frame_time
            while not self._should_stop() and self._pacer.take_step() and self.step_simulation():
                if time.perf_counter() >= deadline:
                    self._pacer.out_of_time()
                    break
        self._update_stats()
        now = time.perf_counter()
        if now < self._next_frame:
            return False
        # A late frame must not bring the next ones forward.
        self._next_frame = max(self._next_frame + self.frame_time, now)
        with self._pause_on_error("updating the viewer"):
            self.sync_env_to_viewer()
        self._rates.count(frames=1)
        return True

    def step_simulation(self) -> bool:
        """Observe, run the policy and step once. On an error, pause the viewer and return False."""
        with self._pause_on_error("stepping the environment"), torch.no_grad():
            self.sync_viewer_to_env()
            actions = self.policy(self.env.get_observations())
            reset_policy(self.policy, done_mask(self.env.step(actions)))
            self._step_count += 1
            self._total_steps += 1
            self._rates.count(steps=1)
            self.after_env_step()
            return True
        return False

    def _update_stats(self) -> None:
        """Update step and frame rates; called every tick. Subclasses may add statistics."""
        if self._rates.update(time.perf_counter()):
            self.log_performance()

    def _should_stop(self) -> bool:
        return self._interrupted or self._total_steps >= self._step_limit

    # Actions.

    def request_action(self, name: str, payload: Any | None = None) -> None:
        """Queue an action by name, from any thread.

        Names that are not a `ViewerAction` become `CUSTOM`.
        """
        try:
            action = ViewerAction(name.lower())
        except ValueError:
            action = ViewerAction.CUSTOM
        self._actions.put((action, payload))

    def request_reset(self) -> None:
        self.request_action("reset")

    def request_toggle_pause(self) -> None:
        self.request_action("toggle_pause")

    def request_single_step(self) -> None:
        self.request_action("single_step")

    def request_speed_up(self) -> None:
        self.request_action("speed_up")

    def request_speed_down(self) -> None:
        self.request_action("speed_down")

    def request_reset_speed(self) -> None:
        self.request_action("reset_speed")

    def _process_actions(self) -> None:
        handlers: dict[ViewerAction, Callable[[], Any]] = {
            ViewerAction.RESET: self.reset_environment,
            ViewerAction.TOGGLE_PAUSE: self.toggle_pause,
            ViewerAction.SINGLE_STEP: self._single_step,
            ViewerAction.SPEED_UP: self.increase_speed,
            ViewerAction.SPEED_DOWN: self.decrease_speed,
            ViewerAction.RESET_SPEED: self.reset_speed,
        }
        while True:
            try:
                action, payload = self._actions.get_nowait()
            except queue.Empty:
                return
            with self._pause_on_error(f"performing action {action.value!r}"):
                if action in handlers:
                    handlers[action]()
                elif action is ViewerAction.STEER:
                    self.steer(payload)
                elif not self.handle_action(action, payload):
                    self.log(f"Unknown viewer action {action.value!r} (payload {payload!r}).")

    def steer(self, where: Steering | tuple[float, float, float]) -> None:
        """Change the command of the robot in view. Does nothing for tasks whose commands cannot be steered.

        While paused, the key of `TURN_RIGHT`, the right arrow, makes a single step.

        Args:
            where: Direction of a key, or position of a gamepad's sticks (forward, left, turn left), each
                in [-1, 1].
        """
        if self._paused and where is Steering.TURN_RIGHT:
            self._single_step()
            return
        is_key = isinstance(where, Steering)
        self.env.unwrapped.command_manager.steer(
            where.value if is_key else where, self.env_in_view, add=is_key
        )

    def _single_step(self) -> None:
        if self._paused and self._total_steps < self._step_limit:
            self._last_error = None
            self.step_simulation()

    def reset_environment(self) -> None:
        """Reset all environments and, if it is recurrent, the policy."""
        with torch.no_grad():
            self.env.reset()
        reset = getattr(self.policy, "reset", None)
        if callable(reset):
            reset()
        self._step_count = 0
        self._pacer.clear()
        self._last_error = None
        self.after_reset()

    def pause(self) -> None:
        """Stop stepping; the display keeps updating."""
        if not self._paused:
            self._paused = True
            self._pacer.clear()
            self.on_paused(True)

    def resume(self) -> None:
        """Resume stepping and clear the last error."""
        if self._paused:
            self._paused = False
            self._last_error = None
            self._pacer.clear()
            self._rates.restart(time.perf_counter())
            self.on_paused(False)

    def toggle_pause(self) -> None:
        if self._paused:
            self.resume()
        else:
            self.pause()

    def increase_speed(self) -> None:
        self._pacer.change_speed(+1)

    def decrease_speed(self) -> None:
        self._pacer.change_speed(-1)

    def reset_speed(self) -> None:
        self._pacer.reset_speed()

    # Status.

    @property
    def target_realtime(self) -> float:
        """Target of simulated seconds per wall second."""
        return self._pacer.speed

    @property
    def actual_realtime(self) -> float:
        """Simulated seconds per wall second, over the last half second; 0 while paused."""
        return 0.0 if self._paused else self._rates.steps_per_second * self._pacer.step_dt

    def get_status(self) -> ViewerStatus:
        return ViewerStatus(
            paused=self._paused,
            step_count=self._step_count,
            speed_multiplier=self._pacer.speed,
            speed_label=speed_label(self._pacer.speed),
            target_realtime=self.target_realtime,
            actual_realtime=self.actual_realtime,
            smoothed_fps=self._rates.frames_per_second,
            capped=self._pacer.capped,
            last_error=self._last_error,
        )

    def log(self, message: str, level: VerbosityLevel = VerbosityLevel.INFO) -> None:
        """Log `message` if the viewer's verbosity is at least `level`."""
        if self.verbosity >= level:
            log.info("%s", message)

    def log_performance(self) -> None:
        """Log the rates of the last half second, at level DEBUG."""
        status = self.get_status()
        self.log(
            f"step {status.step_count}: {self._rates.steps_per_second:.0f} steps/s, "
            f"{status.smoothed_fps:.0f} frames/s, {status.actual_realtime:.2f}x real time",
            VerbosityLevel.DEBUG,
        )

    @contextlib.contextmanager
    def _pause_on_error(self, activity: str) -> Generator[None]:
        """On an error, log it with the lines of the user's code, pause, and show its last line."""
        try:
            yield
        except Exception as error:
            last_line = traceback.format_exception_only(error)[-1].strip()
            # A failing display fails at every frame; log the error once.
            if last_line != self._last_error:
                lines = users_lines(error)
                log.error(
                    "The viewer is paused after an error while %s.\n%s%s",
                    activity,
                    lines,
                    last_line,
                )
                log.debug("Its traceback:", exc_info=True)
            self.pause()
            self._last_error = last_line


@dataclass(frozen=True)
class HeadlessResult:
    """Result of `run_headless`."""

    num_steps: int
    """Number of environment steps taken."""
    mean_step_reward: float
    """Weighted reward per step, averaged over steps and environments. As `Train/mean_step_reward`, before
    scaling by the step's duration if `run_headless` is given its factor."""
    num_episodes: int
    """Number of episodes that ended, over all environments."""

    def summary(self, num_envs: int) -> str:
        """Return the result of `num_envs` environments in one line."""
        return (
            f"{counted(self.num_steps, 'step')} in {counted(num_envs, 'environment')}, "
            f"{counted(self.num_episodes, 'episode')} ended, mean reward per step "
            f"{self.mean_step_reward:.4f}"
        )


def run_headless(
    env: EnvProtocol,
    policy: PolicyProtocol,
    num_steps: int,
    on_step: Callable[[int], None] | None = None,
    reward_unit: float = 1.0,
) -> HeadlessResult:
    """Step `env` with `policy` as fast as possible.

    Args:
        env: Environment, or the vector wrapper of rsl_rl; `step` returns four or five values, the
            second being the reward (num_envs,).
        policy: Maps observations to actions (num_envs, num_actions).
        num_steps: Number of environment steps to take.
        on_step: Called after each step with the number of steps taken.
        reward_unit: Factor from weighted rewards to those that `step` returns
            (`mjlab.rl.evaluation.reward_unit`).
    """
    reward_sum = torch.zeros((), device=env.device, dtype=torch.float64)
    episodes = torch.zeros((), device=env.device, dtype=torch.int64)
    with torch.no_grad():
        for step in range(num_steps):
            result = env.step(policy(env.get_observations()))
            reward_sum += result[1].double().mean()
            dones = done_mask(result)
            reset_policy(policy, dones)
            episodes += (dones != 0).sum()
            if on_step is not None:
                on_step(step + 1)
    mean = float(reward_sum) / max(num_steps, 1) / reward_unit
    return HeadlessResult(num_steps, mean, int(episodes))


def done_mask(results: tuple[Any, ...]) -> torch.Tensor:
    """Return the mask of ended episodes (num_envs,), from the four or five results of a step."""
    return results[2] if len(results) == 4 else results[2] | results[3]


def reset_policy(policy: Any, dones: torch.Tensor) -> None:
    """Reset a recurrent policy in the environments with nonzero `dones` (num_envs,)."""
    reset = getattr(policy, "reset", None)
    try:
        accepts_dones = callable(reset) and "dones" in inspect.signature(reset).parameters
    except (TypeError, ValueError):
        # Compiled functions have no signature.
        return
    if accepts_dones:
        reset(dones)


def speed_label(multiplier: float) -> str:
    """Return the label of a speed: `1/4x`, `1x`, `8x`."""
    if multiplier < 1.0:
        return f"1/{round(1.0 / multiplier)}x"
    return f"{multiplier:g}x"


class RealtimePacer:
    """Conversion of elapsed wall time into a budget of simulated time.

    Time not used within one frame is dropped except for a single step: a simulation slower than
    the target lags behind, and the display stays responsive.
    """

    def __init__(self, step_dt: float, frame_period: float, speeds: Sequence[float] = SPEEDS):
        self.step_dt = step_dt
        self.frame_period = frame_period
        self.capped = False
        self._speeds = tuple(speeds)
        self._budget = 0.0
        self.reset_speed()

    @property
    def speed(self) -> float:
        """Target speed as a multiple of real time."""
        return self._speeds[self._speed_index]

    def change_speed(self, steps: int) -> None:
        """Move `steps` up (negative: down) in the list of speeds, clamped to its ends."""
        self._speed_index = min(max(self._speed_index + steps, 0), len(self._speeds) - 1)

    def reset_speed(self) -> None:
        """Select real time, or the speed nearest to it."""
        ratios = [abs(math.log(speed)) for speed in self._speeds]
        self._speed_index = ratios.index(min(ratios))

    def add(self, elapsed: float) -> None:
        """Add `elapsed` seconds of wall time to the budget of a new frame."""
        self._budget += elapsed * self.speed
        self.capped = False

    def take_step(self) -> bool:
        """Subtract one step from the budget; return False if the budget is too small."""
        # Rounding errors of many small increments must not cost a whole step.
        if self._budget < self.step_dt * (1.0 - 1e-9):
            return False
        self._budget = max(self._budget - self.step_dt, 0.0)
        return True

    @property
    def time_to_next_step(self) -> float:
        """Wall time until the budget suffices for a step (s)."""
        return max(self.step_dt - self._budget, 0.0) / self.speed

    def out_of_time(self) -> None:
        """End the frame's wall time: cut the remaining budget to one step."""
        self.capped = self._budget >= self.step_dt
        self._budget = min(self._budget, self.step_dt)

    def clear(self) -> None:
        """Clear the budget: time spent paused is not made up."""
        self._budget = 0.0
        self.capped = False


class RateMeter:
    """Steps and frames per second, averaged over half a second of wall time."""

    def __init__(self, now: float):
        self.steps_per_second = 0.0
        self.frames_per_second = 0.0
        self._start = now
        self._steps = 0
        self._frames = 0

    def count(self, steps: int = 0, frames: int = 0) -> None:
        self._steps += steps
        self._frames += frames

    def update(self, now: float) -> bool:
        """Close the averaging window if it is full; return True if the rates changed."""
        elapsed = now - self._start
        if elapsed < _STATS_WINDOW_S:
            return False
        self.steps_per_second = self._steps / elapsed
        self.frames_per_second = self._frames / elapsed
        self._start = now
        self._steps = self._frames = 0
        return True

    def restart(self, now: float) -> None:
        """Clear counts and rates, e.g. after a pause."""
        self._start = now
        self._steps = self._frames = 0
        self.steps_per_second = self.frames_per_second = 0.0


class TermHistory:
    """Last `length` values of each term of a manager, for one environment."""

    def __init__(self, length: int):
        self.length = length
        self._values: dict[str, deque[float]] = {}

    @property
    def names(self) -> list[str]:
        return list(self._values)

    def add(self, terms: Iterable[tuple[str, Sequence[float]]]) -> None:
        """Append one point per term, as returned by `get_active_iterable_terms(env_idx)`.

        Non-finite values are recorded as NaN; plots skip them.
        """
        for name, values in terms:
            value = float(np.ravel(values)[0])
            series = self._values.setdefault(name, deque(maxlen=self.length))
            series.append(value if np.isfinite(value) else float("nan"))

    def values(self, name: str) -> np.ndarray:
        """Return the points of one term, oldest first, (count,)."""
        return np.array(self._values.get(name, ()), dtype=float)

    def mean(self, name: str) -> float:
        """Return the mean of the finite points, or 0 without any."""
        values = self.values(name)
        finite = values[np.isfinite(values)]
        return float(finite.mean()) if len(finite) else 0.0

    def clear(self) -> None:
        """Clear the points and keep the names."""
        for series in self._values.values():
            series.clear()


__getattr__ = older_names(__name__)
