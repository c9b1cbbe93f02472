"""Watch a policy that comes with the package: `uv run demo`, `uv run demo g1`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mjlab.scripts.cli import run_alias
from mjlab.utils.errors import UserError, check_one_of

if TYPE_CHECKING:
    from mjlab.scripts.play import PlayConfig

_FOLDER = Path(__file__).parents[1] / "demo"


@dataclass(frozen=True)
class Demo:
    """A policy that comes with the package; the README beside it says how it was made."""

    task: str
    """The task that it was trained for."""
    profile: str | None
    """The profile of the task that its observations and actions are of."""
    policy: Path
    """The exported policy."""


DEMOS = {
    "go1": Demo("Mjlab-Velocity-Flat-Unitree-Go1", None, _FOLDER / "go1_velocity.onnx"),
    "g1": Demo("Mjlab-Velocity-Flat-Unitree-G1", "cpu", _FOLDER / "g1_velocity.onnx"),
}


def demo_cfg(demo: Demo) -> PlayConfig:
    """Return what `demo` plays unless flags say otherwise: one robot, on the CPU, in the browser."""
    from mjlab.scripts.play import PlayConfig
    from mjlab.scripts.policy import policy_env_cfg
    from mjlab.sensor import RayCastSensorCfg

    env = policy_env_cfg(demo.task, demo.profile, purpose="play")
    for sensor in env.scene.sensors:
        # A first look is at the robot, not at what its sensors see.
        if isinstance(sensor, RayCastSensorCfg):
            sensor.debug_vis = False
    return PlayConfig(
        env=env,
        checkpoint_file=str(demo.policy),
        num_envs=1,
        device="cpu",
        viewer="viser",
        open_browser=True,
    )


def run_demo(demo: Demo, cfg: PlayConfig) -> None:
    """Play `cfg`.

    Raises:
        UserError: the policy is not there, or what was asked for cannot be done.
    """
    from mjlab.scripts.play import run_play

    plays_its_own = cfg.agent == "trained" and cfg.checkpoint_file == str(demo.policy)
    if plays_its_own and not demo.policy.is_file():
        raise UserError(
            f"The demo's policy {demo.policy} does not exist. Name a policy of {demo.task} with "
            "--checkpoint-file FILE.onnx; `train` leaves one in the folder of every run."
        )
    run_play(demo.task, cfg)


def command(argv: list[str], prog: str) -> None:
    """Run `demo`."""
    name, flags = ("go1", argv) if not argv or argv[0].startswith("-") else (argv[0], argv[1:])
    check_one_of("demo", name, DEMOS)
    from mjlab.scripts.flags import parse_flags
    from mjlab.scripts.play import PlayConfig

    demo = DEMOS[name]
    run_demo(demo, parse_flags(PlayConfig, demo_cfg(demo), flags, prog=f"{prog} {name}"))


def main() -> None:
    """Entry point of `demo`."""
    run_alias("demo")


if __name__ == "__main__":
    main()
