"""Video recording of policies."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.runs import Checkpoint
from mjlab.runs.policy import agent_cfg_of, make_env, make_policy
from mjlab.utils.string import counted
from mjlab.utils.wrappers.video_recorder import ClipWriter
from mjlab.viewer.base import done_mask, reset_policy


@dataclass(frozen=True)
class VideoCfg:
    """Recording configuration."""

    length: int = 200
    """Number of frames, one per environment step."""
    height: int | None = None
    """Height (pixels). None: height of the task."""
    width: int | None = None
    """Width (pixels). None: width of the task."""
    suffix: Literal["mp4", "gif"] = "mp4"
    """File format."""
    camera: int | str | None = None
    """Model camera, name or index. None: viewer camera of the task."""
    agent: str = "trained"
    """Policy without a checkpoint: `zero` or `random`."""
    profile: str | None = None
    """Task profile used for training."""


def record_policy(
    task: str,
    env_cfg: ManagerBasedRlEnvCfg,
    checkpoint: Checkpoint | None,
    folder: Path,
    device: str,
    video: VideoCfg | None = None,
) -> Path | None:
    """Record one clip into `folder`, print its path and return it.

    Raises:
        RenderingUnavailableError: rendering is not available; the message names packages to install.
    """
    video = video or VideoCfg()
    name = video.agent if checkpoint is None else checkpoint.path.stem
    path = folder / f"{task}-{name}.{video.suffix}"
    written = write_clip(task, env_cfg, checkpoint, path, device, video)
    print(f"Video: {written}")
    return written


def write_clip(
    task: str,
    env_cfg: ManagerBasedRlEnvCfg,
    checkpoint: Checkpoint | None,
    path: Path,
    device: str,
    video: VideoCfg,
) -> Path | None:
    """Record one clip to the file `path` and return it; None without frames.

    Raises:
        RenderingUnavailableError: rendering is not available; the message names packages to install.
    """
    env_cfg = copy.deepcopy(env_cfg)
    env_cfg.viewer.height = video.height or env_cfg.viewer.height
    env_cfg.viewer.width = video.width or env_cfg.viewer.width
    agent = agent_cfg_of(task, checkpoint, video.profile)
    env = make_env(task, env_cfg, device, render_mode="rgb_array", agent=agent)
    try:
        policy = make_policy(task, env, video.agent, checkpoint, device, video.profile)
        writer = ClipWriter(path, env.unwrapped.metadata["render_fps"])
        size = f"{env_cfg.viewer.width} x {env_cfg.viewer.height} pixels"
        print(f"Recording a clip: {counted(video.length, 'frame')} of {size} ...", flush=True)
        with torch.inference_mode():
            for _ in range(video.length):
                reset_policy(policy, done_mask(env.step(policy(env.get_observations()))))
                writer.add(env.unwrapped.render(video.camera))
        return writer.close()
    finally:
        env.close()
