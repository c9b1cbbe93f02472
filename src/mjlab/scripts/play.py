"""Play a policy: `uv run mjlab play TASK|POLICY [flags]`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from mjlab.cli.devices import resolve_device
from mjlab.cli.main import run_alias
from mjlab.cli.policy_flags import (
    PolicyFlags,
    env_cfg_of,
    find_checkpoint,
    parse_policy_flags,
    report_policy,
    task_and_flags,
)
from mjlab.cli.record import VideoCfg, record_policy
from mjlab.compat import older_names
from mjlab.runs import Checkpoint, Run
from mjlab.runs.policy import agent_cfg_of, load_policy, make_env, make_policy
from mjlab.runs.source import is_fetched
from mjlab.utils.errors import UserError
from mjlab.utils.logging import print_notice
from mjlab.utils.ranges import Count, CountOrZero
from mjlab.utils.screen import shown
from mjlab.utils.torch import threads_for_policy
from mjlab.viewer.base import run_headless
from mjlab.viewer.page_server import check_address, open_browser

__getattr__ = older_names(__name__)


@dataclass
class PlayConfig(PolicyFlags):
    """Flags of `play`."""

    video: bool = field(default=False, metadata=shown("record"))
    """Record a clip instead of opening a viewer."""
    video_length: CountOrZero = field(default=200, metadata=shown("record", "N"))
    """Frames of the clip."""
    video_format: Literal["mp4", "gif"] = field(default="mp4", metadata=shown("record", "mp4|gif"))
    """Format of the clip."""
    video_height: Count | None = field(default=None, metadata=shown("record", "N"))
    """Height of the clip, in pixels."""
    video_width: Count | None = field(default=None, metadata=shown("record", "N"))
    """Width of the clip, in pixels."""
    camera: int | str | None = field(default=None, metadata=shown("record", "NAME"))
    """Model camera to record from, name or index. None: viewer camera of the task."""
    viewer: Literal["auto", "native", "viser", "none"] = field(
        default="auto", metadata=shown("watch", "viser|native|none")
    )
    """Viewer: `viser` (page in the browser; also `auto`), `native` (MuJoCo's window) or `none`
    (headless)."""
    num_steps: Count | None = field(default=None, metadata=shown("watch", "N"))
    """Number of environment steps. None: play until stopped."""
    host: str = field(default="127.0.0.1", metadata=shown("watch", "ADDRESS"))
    """Address of the page. 0.0.0.0: all interfaces."""
    port: int = field(default=8080, metadata=shown("watch", "N"))
    """Port of the page."""
    open_browser: bool = field(default=True, metadata=shown("watch", "False"))
    """Open the page in a browser on this machine, if a display is available; not over SSH."""
    no_terminations: bool = field(default=False, metadata=shown("watch"))
    """Remove all terminations, including the time limit."""


def command(argv: list[str], prog: str) -> None:
    """Run `play`."""
    task, flags = task_and_flags(argv)
    run_play(task, parse_policy_flags(PlayConfig, flags, task, prog, purpose="play"))


def run_play(task: str, cfg: PlayConfig) -> None:
    """Play `task` with the flags `cfg`.

    Raises:
        UserError, ValueError, OSError, CheckpointError, EngineUnavailableError,
        RenderingUnavailableError: the request cannot be fulfilled.
    """
    if cfg.viewer == "none" and cfg.num_steps is None and not cfg.video:
        raise UserError(
            "--viewer none: expected --num-steps, because nothing else would end playing, got none."
        )
    if cfg.video and cfg.video_length < 1:
        print_notice(
            f"--video-length: expected at least 1 frame, got {cfg.video_length}; one is recorded."
        )
    # Imported late: `--help` does not need it.
    from mjlab.rl.evaluation import reward_unit

    check_address(cfg.host, cfg.port, "--")
    device = resolve_device(cfg.device)
    checkpoint = find_checkpoint(task, cfg)
    env_cfg = env_cfg_of(task, cfg, checkpoint, purpose="play")
    report_policy(task, checkpoint, cfg, env_cfg, "play")
    if cfg.no_terminations:
        env_cfg.terminations = {}
    if cfg.video:
        folder = Path("videos")
        run_dir = None if checkpoint is None else checkpoint.path.parent
        if run_dir is not None and Run(run_dir, task).exists and not is_fetched(run_dir):
            folder = run_dir / "videos" / "play"
        video = VideoCfg(
            length=cfg.num_steps or max(cfg.video_length, 1),
            suffix=cfg.video_format,
            height=cfg.video_height,
            width=cfg.video_width,
            camera=cfg.camera,
            agent=cfg.agent,
            profile=cfg.profile,
        )
        record_policy(task, env_cfg, checkpoint, folder, device, video)
        return
    agent = agent_cfg_of(task, checkpoint, cfg.profile)
    env = make_env(task, env_cfg, device, agent=agent)
    print(f"Physics:    {env.unwrapped.sim.capabilities.description}")
    try:
        policy = make_policy(task, env, cfg.agent, checkpoint, device, cfg.profile)
        with threads_for_policy(policy, env.num_envs, device):
            if cfg.viewer == "none" and cfg.num_steps is not None:
                result = run_headless(env, policy, cfg.num_steps, reward_unit=reward_unit(env))
                print(result.summary(env.num_envs))
            else:
                viewer = _make_viewer(task, cfg, env, policy, checkpoint, device)
                viewer.run(num_steps=cfg.num_steps)
    finally:
        env.close()


def _make_viewer(
    task: str, cfg: PlayConfig, env: Any, policy: Any, checkpoint: Checkpoint | None, device: str
) -> Any:
    if cfg.viewer == "native":
        from mjlab.viewer import NativeMujocoViewer

        return NativeMujocoViewer(env, policy)
    from mjlab.viewer import ViserPlayViewer
    from mjlab.viewer.viser.viewer import local_checkpoints

    manager = None
    if checkpoint is not None and any(checkpoint.path.parent.glob("*.pt")):
        manager = local_checkpoints(
            checkpoint.path.parent,
            lambda path: load_policy(task, env, path, device, cfg.profile),
            current=checkpoint.path.name,
        )
    viewer = ViserPlayViewer(env, policy, checkpoint_manager=manager, host=cfg.host, port=cfg.port)
    print(f"Open {viewer.url} in a browser. Ctrl-C ends.", flush=True)
    if cfg.open_browser:
        open_browser(viewer.url)
    return viewer


def main() -> None:
    """Entry point of `play`."""
    run_alias("play")


if __name__ == "__main__":
    main()
