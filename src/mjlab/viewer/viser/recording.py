"""Recording of episodes for a page without a server: scene in 3-D, commands and rewards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
import viser

from mjlab.utils.string import counted
from mjlab.viewer.base import done_mask, reset_policy
from mjlab.viewer.page_server import serve_page
from mjlab.viewer.viser.scene import scene_of

if TYPE_CHECKING:
    from mjlab.viewer.base import EnvProtocol, PolicyProtocol
    from mjlab.viewer.debug_visualizer import Color


@dataclass(frozen=True)
class Episode:
    """Recorded episode."""

    start: float
    """Time in the recording (s)."""
    seconds: float
    """Duration (s)."""
    total_reward: float
    """Sum of the rewards that the environment returned."""
    ended_by: tuple[str, ...]
    """Names of the terminations that ended it; empty if the recording did."""


@dataclass
class Recording:
    """Episodes of the first environment, one after the other."""

    html: str = ""
    """Page of the scene, with a time slider."""
    episodes: list[Episode] = field(default_factory=list)
    """Episodes."""
    times: list[float] = field(default_factory=list)
    """Times of the frames (s), (F,)."""
    commands: dict[str, list[list[float]]] = field(default_factory=dict)
    """Commands by name, flat, (F, size)."""
    rewards: dict[str, list[float]] = field(default_factory=dict)
    """Weighted rewards per step by term, (F,); NaN at the start of an episode."""
    legend: dict[str, Color] = field(default_factory=dict)
    """Colors of the drawings, by meaning."""


def record_episodes(
    env: EnvProtocol,
    policy: PolicyProtocol,
    num_episodes: int,
    seconds: float,
    fps: float,
    report: Callable[[str], object] = lambda text: None,
) -> Recording:
    """Play episodes and record them. All environments are drawn; the first one is followed.

    Args:
        env: Environment, or the wrapper that `policy` expects.
        policy: Policy.
        num_episodes: Number of episodes.
        seconds: Longest duration of an episode (s).
        fps: Frames per second, at most one per step.
        report: Called with a line of progress before each episode.
    """
    server = serve_page()
    try:
        recorder = _Recorder(env.unwrapped, server, fps)
        with torch.inference_mode():
            for i in range(num_episodes):
                report(f"Recording: episode {i + 1} of {counted(num_episodes, 'episode')}")
                recorder.play(env, policy, seconds)
        recorder.recording.html = recorder.serializer.as_html()
    finally:
        server.stop()
    return recorder.recording


class _Recorder:
    """Scene of a page that nobody visits, and what is recorded of it."""

    def __init__(self, env: Any, server: viser.ViserServer, fps: float) -> None:
        self.recording = Recording()
        self._env = env
        self._steps = max(1, round(1.0 / (fps * env.step_dt)))
        self._time = 0.0
        self._scene = scene_of(env, server)
        # Phones and browsers without a GPU show it within seconds.
        self._scene.set_plain_look()
        self._rewards = env.reward_manager
        self._weighted = [
            name for name in self._rewards.active_terms if self._rewards.get_term_cfg(name).weight
        ]
        self.serializer = server.get_scene_serializer()

    def play(self, env: EnvProtocol, policy: PolicyProtocol, seconds: float) -> None:
        """Record an episode from a reset to its end, `seconds` at most."""
        env.reset()
        if callable(reset := getattr(policy, "reset", None)):
            reset()
        start, step_dt = self._time, self._env.step_dt
        total, steps, ended_by = 0.0, 0, ()
        self._add_frame(dict.fromkeys(self._weighted, float("nan")))
        while not ended_by and steps < round(seconds / step_dt):
            result = env.step(policy(env.get_observations()))
            dones = done_mask(result)
            reset_policy(policy, dones)
            total, steps = total + float(result[1][0]), steps + 1
            if dones[0]:
                ended_by = self._terminations()
            elif steps % self._steps == 0:
                terms = self._rewards.get_active_iterable_terms(0)
                self._add_frame({name: value[0] for name, value in terms})
        self.recording.episodes.append(Episode(start, steps * step_dt, total, ended_by))

    def _add_frame(self, rewards: dict[str, float]) -> None:
        recording, scene = self.recording, self._scene
        scene.clear()
        self._env.update_visualizers(scene)
        scene.update(self._env.sim, 0)
        recording.legend |= scene.legend
        recording.times.append(self._time)
        for name in self._weighted:
            recording.rewards.setdefault(name, []).append(rewards[name])
        commands = self._env.command_manager
        for name in commands.active_terms:
            value = commands.get_command(name)[0].flatten().tolist()
            recording.commands.setdefault(name, []).append(value)
        frame = self._steps * self._env.step_dt
        self.serializer.insert_sleep(frame)
        self._time += frame

    def _terminations(self) -> tuple[str, ...]:
        manager = self._env.termination_manager
        names = [name for name in manager.active_terms if bool(manager.get_term(name)[0])]
        return tuple(names) or ("diverged physics",)
