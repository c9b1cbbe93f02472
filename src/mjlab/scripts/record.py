"""Record a policy as a video."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.scripts.environments import make_env
from mjlab.scripts.policy import make_policy
from mjlab.utils.wrappers.video_recorder import ClipWriter
from mjlab.viewer.base import ended, forget


@dataclass(frozen=True)
class VideoCfg:
    """What a recording looks like."""

    length: int = 200
    """Frames, one an environment step."""
    height: int | None = None
    """Height in pixels; None keeps the task's."""
    width: int | None = None
    """Width in pixels; None keeps the task's."""
    suffix: Literal["mp4", "gif"] = "mp4"
    """Format of the file."""
    camera: int | str | None = None
    """Camera of the model, by name or index; None is the task's own view."""
    num_envs: int | None = None
    """Number of environments; None keeps the task's."""
    engine: Any = None
    """Physics engine; None keeps the task's."""
    agent: str = "trained"
    """Who acts where there is no checkpoint: `zero` or `random`."""
    profile: str | None = None
    """Profile of the task that the policy was trained with."""


def record_policy(
    task: str,
    env_cfg: ManagerBasedRlEnvCfg,
    checkpoint: Path | None,
    folder: Path,
    device: str,
    video: VideoCfg | None = None,
) -> Path | None:
    """Record one clip into `folder` and return its path.

    Raises:
        RenderingUnavailableError: this machine cannot render; the message says what to install.
    """
    video = video or VideoCfg()
    env_cfg = copy.deepcopy(env_cfg)
    env_cfg.viewer.height = video.height or env_cfg.viewer.height
    env_cfg.viewer.width = video.width or env_cfg.viewer.width
    env = make_env(
        task,
        env_cfg,
        device,
        video.num_envs,
        video.engine,
        render_mode="rgb_array",
        profile=video.profile,
    )
    try:
        policy = make_policy(task, env, video.agent, checkpoint, device, video.profile)
        name = video.agent if checkpoint is None else checkpoint.stem
        writer = ClipWriter(
            folder / f"{task}-{name}.{video.suffix}", env.unwrapped.metadata["render_fps"]
        )
        with torch.inference_mode():
            for _ in range(video.length):
                forget(policy, ended(env.step(policy(env.get_observations()))))
                writer.add(env.unwrapped.render(video.camera))
        path = writer.close()
    finally:
        env.close()
    print(f"Video: {path}")
    return path
