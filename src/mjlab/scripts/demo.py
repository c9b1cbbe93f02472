"""Watch the policy that comes with the package: `uv run demo`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from mjlab.scripts.cli import UserError, parse_flags, run_command

if TYPE_CHECKING:
    from mjlab.scripts.play_run import PlayConfig

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"
"""The task that the policy was trained for."""
POLICY = Path(__file__).parents[1] / "demo" / "go1_velocity.onnx"
"""The policy; the README beside it says how it was made."""

_USAGE = f"""usage: demo [flags]

Play a Unitree Go1 that walks as told, in the browser and offline. Flags are those of `play`:

    uv run demo
    uv run demo --num-envs 4 --port 8090
    uv run demo --viewer none --video True

It plays {TASK}."""


def demo_cfg() -> PlayConfig:
    """Return what `demo` plays unless flags say otherwise: one robot, on the CPU, in the browser."""
    from mjlab.scripts.play_run import PlayConfig
    from mjlab.scripts.policy import policy_env_cfg
    from mjlab.sensor import RayCastSensorCfg

    env = policy_env_cfg(TASK, None, purpose="play")
    for sensor in env.scene.sensors:
        # A first look is at the robot, not at what its sensors see.
        if isinstance(sensor, RayCastSensorCfg):
            sensor.debug_vis = False
    return PlayConfig(
        env=env,
        checkpoint_file=str(POLICY),
        num_envs=1,
        device="cpu",
        viewer="viser",
        open_browser=True,
    )


def run_demo(cfg: PlayConfig) -> None:
    """Play `cfg`.

    Raises:
        UserError: the policy is not there, or what was asked for cannot be done.
    """
    from mjlab.scripts.play_run import run_play

    if cfg.agent == "trained" and cfg.checkpoint_file == str(POLICY) and not POLICY.is_file():
        raise UserError(
            f"The demo has no policy of its own yet: there is no {POLICY}. Name a policy of {TASK} "
            "with --checkpoint-file FILE.onnx; `train` leaves one in the folder of every run."
        )
    run_play(TASK, cfg)


def _command(argv: list[str]) -> None:
    if argv[:1] in (["-h"], ["--help"]):
        print(_USAGE)
        return
    from mjlab.scripts.play_run import PlayConfig

    run_demo(parse_flags(PlayConfig, demo_cfg(), argv, prog="demo"))


def main() -> None:
    """Entry point of `demo`."""
    run_command(_command)


if __name__ == "__main__":
    main()
