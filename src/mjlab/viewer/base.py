"""The loop all interactive viewers share: pacing, pausing, actions and errors."""

from __future__ import annotations

import contextlib
import logging
import queue
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator
from typing import Any, ClassVar

import torch

from mjlab.compat import older_names
from mjlab.viewer.interrupt import first_interrupt_calls
from mjlab.viewer.pacing import SPEEDS, RateMeter, RealtimePacer, speed_label
from mjlab.viewer.protocols import EnvProtocol as EnvProtocol
from mjlab.viewer.protocols import PolicyProtocol as PolicyProtocol
from mjlab.viewer.protocols import VerbosityLevel as VerbosityLevel
from mjlab.viewer.protocols import ViewerAction as ViewerAction
from mjlab.viewer.protocols import ViewerStatus as ViewerStatus
from mjlab.viewer.protocols import ended, forget

log = logging.getLogger(__name__)

# Longest sleep between two looks at what is due, so that buttons answer at once.
_MAX_SLEEP_S = 0.005
_MIN_SLEEP_S = 0.0005


class BaseViewer(ABC):
    """Steps an environment with a policy in real time, and lets a subclass show it.

    Everything that touches the environment happens in the thread that calls `run`. Buttons and
    keys, whose callbacks arrive in other threads, put actions into a queue (`request_action`).
    """

    SPEED_MULTIPLIERS: ClassVar[list[float]] = list(SPEEDS)
    """Selectable speeds, as multiples of real time, in rising order."""

    def __init__(
        self,
        env: EnvProtocol,
        policy: PolicyProtocol,
        frame_rate: float = 30.0,
        verbosity: int = VerbosityLevel.SILENT,
    ) -> None:
        """Prepare a paused-off viewer at real-time speed.

        Args:
            env: Environment or wrapper whose observations `policy` takes.
            policy: Maps observations to actions.
            frame_rate: Displayed frames per second of wall time.
            verbosity: How much to log, a `VerbosityLevel`.

        Raises:
            ValueError: The frame rate is not positive.
        """
        if frame_rate <= 0:
            raise ValueError(f"frame_rate is {frame_rate}; it must be positive.")
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
        self._step_limit: int | None = None
        now = time.perf_counter()
        self._rates = RateMeter(now)
        self._last_tick = now
        self._next_frame = now

    # What a subclass provides.

    @abstractmethod
    def setup(self) -> None:
        """Open the window or page."""

    @abstractmethod
    def is_running(self) -> bool:
        """Whether the window or page is still there."""

    @abstractmethod
    def sync_env_to_viewer(self) -> None:
        """Show the environment's present state; called once a displayed frame."""

    @abstractmethod
    def sync_viewer_to_env(self) -> None:
        """Bring what the person did in the viewer (a push, say) into the environment."""

    @abstractmethod
    def close(self) -> None:
        """Close the window or page; may be called twice."""

    def after_env_step(self) -> None:  # noqa: B027, optional
        """Called after every environment step, before anything else happens."""

    def after_reset(self) -> None:  # noqa: B027, optional
        """Called after the environments have been reset."""

    def on_paused(self, paused: bool) -> None:  # noqa: B027, optional
        """Called when the viewer is paused or resumed."""

    def handle_action(self, action: ViewerAction, payload: Any) -> bool:
        """Handle an action that the base does not know; False means it is not known here."""
        return False

    # The loop.

    def run(self, num_steps: int | None = None, catch_sigint: bool = True) -> None:
        """Show the environment until the viewer is closed, then close it.

        Args:
            num_steps: Stop after so many environment steps; None runs until closed.
            catch_sigint: Let the first Ctrl+C end the loop, and only a second one the program.
        """
        self._interrupted = False
        self._step_limit = None if num_steps is None else self._total_steps + num_steps
        with first_interrupt_calls(self._interrupt, enabled=catch_sigint):
            try:
                self.setup()
                self._last_tick = self._next_frame = time.perf_counter()
                self._rates.restart(self._last_tick)
                while self.is_running() and not self._should_stop():
                    if not self.tick():
                        time.sleep(self._time_until_due())
            finally:
                self.close()

    def tick(self) -> bool:
        """Do what is due now: actions, environment steps, a frame. True if a frame was shown."""
        now = time.perf_counter()
        elapsed, self._last_tick = now - self._last_tick, now
        self._process_actions()
        if not self._paused:
            self._pacer.add(elapsed)
            self._step_within_budget()
        self._update_stats()
        return self._show_frame_if_due()

    def step_simulation(self) -> bool:
        """Observe, ask the policy, step once. False if that failed, which pauses the viewer."""
        with self._pause_on_error("stepping the environment"), torch.no_grad():
            self.sync_viewer_to_env()
            actions = self.policy(self.env.get_observations())
            forget(self.policy, ended(self.env.step(actions)))
            self._step_count += 1
            self._total_steps += 1
            self._rates.count(steps=1)
            self.after_env_step()
            return True
        return False

    def _update_stats(self) -> None:
        """Average the rates of steps and frames; called every tick, subclasses may add theirs."""
        if self._rates.update(time.perf_counter()):
            self.log_performance()

    def _limit_reached(self) -> bool:
        return self._step_limit is not None and self._total_steps >= self._step_limit

    def _should_stop(self) -> bool:
        return self._interrupted or self._limit_reached()

    def _interrupt(self) -> None:
        self._interrupted = True

    def _step_within_budget(self) -> None:
        self._pacer.capped = False
        deadline = time.perf_counter() + self.frame_time
        while not self._should_stop() and self._pacer.take_step():
            if not self.step_simulation():
                return
            if time.perf_counter() >= deadline:
                self._pacer.out_of_time()
                return

    def _time_until_due(self) -> float:
        """Seconds until the next step or frame, within the bounds of a sleep."""
        due = self._next_frame - time.perf_counter()
        if not self._paused:
            due = min(due, self._pacer.time_to_next_step)
        return min(max(due, _MIN_SLEEP_S), _MAX_SLEEP_S)

    def _show_frame_if_due(self) -> bool:
        now = time.perf_counter()
        if now < self._next_frame:
            return False
        # A frame that came late does not make the next ones come early.
        self._next_frame = max(self._next_frame + self.frame_time, now)
        with self._pause_on_error("updating the viewer"):
            self.sync_env_to_viewer()
        self._rates.count(frames=1)
        return True

    # Actions.

    def request_action(self, name: str, payload: Any | None = None) -> None:
        """Queue an action by name, from any thread.

        A name that is not a `ViewerAction` becomes `CUSTOM`, with its payload.
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
        while True:
            try:
                action, payload = self._actions.get_nowait()
            except queue.Empty:
                return
            with self._pause_on_error(f"performing the action {action.value!r}"):
                self._perform(action, payload)

    def _perform(self, action: ViewerAction, payload: Any) -> None:
        known: dict[ViewerAction, Callable[[], Any]] = {
            ViewerAction.RESET: self.reset_environment,
            ViewerAction.TOGGLE_PAUSE: self.toggle_pause,
            ViewerAction.SINGLE_STEP: self._single_step,
            ViewerAction.SPEED_UP: self.increase_speed,
            ViewerAction.SPEED_DOWN: self.decrease_speed,
            ViewerAction.RESET_SPEED: self.reset_speed,
        }
        if action in known:
            known[action]()
        elif not self.handle_action(action, payload):
            self.log(f"This viewer does not know the action {action.value!r} ({payload!r}).")

    def _single_step(self) -> None:
        if self._paused and not self._limit_reached():
            self._last_error = None
            self.step_simulation()

    def reset_environment(self) -> None:
        """Reset all environments, and the policy where it has a memory."""
        with torch.no_grad():
            self.env.reset()
        reset_policy = getattr(self.policy, "reset", None)
        if callable(reset_policy):
            reset_policy()
        self._step_count = 0
        self._pacer.clear()
        self._last_error = None
        self.after_reset()

    def pause(self) -> None:
        """Stop stepping; the display goes on."""
        if not self._paused:
            self._paused = True
            self._pacer.clear()
            self.on_paused(True)

    def resume(self) -> None:
        """Go on stepping. What was wrong is taken as seen."""
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
        """Simulated seconds per wall second that were asked for."""
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
        """Log `message` if the viewer is as talkative as `level`."""
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
    def _pause_on_error(self, doing: str) -> Generator[None]:
        """Keep the viewer alive: log the traceback, pause, and show the error's last line."""
        try:
            yield
        except Exception as error:
            last_line = traceback.format_exception_only(error)[-1].strip()
            # A display that fails does so at every frame; say it once.
            if last_line != self._last_error:
                log.exception("The viewer is paused after an error while %s.", doing)
            self.pause()
            self._last_error = last_line


__getattr__ = older_names(__name__)
