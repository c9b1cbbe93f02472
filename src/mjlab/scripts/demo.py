"""Play a bundled policy: `uv run mjlab demo`, `uv run mjlab demo g1`, `uv run mjlab demo g1-tracking`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mjlab.cli.main import run_alias
from mjlab.utils.errors import check_one_of

if TYPE_CHECKING:
    from mjlab.scripts.play import PlayConfig

_FOLDER = Path(__file__).parents[1] / "demo"


@dataclass(frozen=True)
class Demo:
    """Bundled policy. The README beside the policy documents its training."""

    task: str
    """Task of the policy."""
    profile: str | None
    """Profile that defines the observations and actions of the policy."""
    policy: Path
    """Path of the exported policy."""
    evaluation: Path
    """Path of its evaluation."""
    run: str
    """Name of the run."""
    iteration: int
    """Iterations of the training."""
    seed: int
    """Seed of the training."""
    commit: str | None
    """Commit of the code that trained the policy; None: not recorded."""


DEMOS = {
    "go1": Demo(
        "Mjlab-Velocity-Flat-Unitree-Go1-No-State-Estimation",
        None,
        _FOLDER / "go1_velocity.onnx",
        _FOLDER / "evaluation.json",
        run="2026-11-26_09-41-23",
        iteration=718,
        seed=1,
        commit=None,
    ),
    "g1": Demo(
        "Mjlab-Velocity-Flat-Unitree-G1-No-State-Estimation",
        "cpu",
        _FOLDER / "g1_velocity.onnx",
        _FOLDER / "g1_evaluation.json",
        run="2026-11-26_21-18-47",
        iteration=110,
        seed=1,
        commit="602bee2519714029bce19f214cad88be1edca66b",
    ),
    "g1-tracking": Demo(
        "Mjlab-Tracking-Flat-Unitree-G1",
        None,
        _FOLDER / "g1_tracking.onnx",
        _FOLDER / "g1_tracking_evaluation.json",
        run="2026-11-27_07-11-50",
        iteration=600,
        seed=1,
        commit="b74655ede50446a251965eb8620c00c587ceae3e",
    ),
}


def demo_of(policy: Path) -> Demo | None:
    """Return the bundled policy in a file; None: it is none of them."""
    return next((demo for demo in DEMOS.values() if demo.policy == policy), None)


def demo_cfg(demo: Demo) -> PlayConfig:
    """Return the default flags of `demo`: one robot, on the CPU, in the browser."""
    from mjlab.scripts.play import PlayConfig
    from mjlab.sensor import RayCastSensorCfg
    from mjlab.tasks.registry import load_env_cfg

    env = load_env_cfg(demo.task, play=True, profile=demo.profile)
    for sensor in env.scene.sensors:
        # Rays would distract from the robot.
        if isinstance(sensor, RayCastSensorCfg):
            sensor.debug_vis = False
    # Walking was trained at the task's first command ranges; `play` has those of its last stage.
    if "twist" in env.commands:
        env.commands["twist"] = load_env_cfg(demo.task, profile=demo.profile).commands["twist"]
    return PlayConfig(
        env=env,
        profile=demo.profile,
        checkpoint_file=str(demo.policy),
        num_envs=1,
        device="cpu",
        viewer="viser",
    )


def command(argv: list[str], prog: str) -> None:
    """Run `demo`."""
    name, flags = ("go1", argv) if not argv or argv[0].startswith("-") else (argv[0], argv[1:])
    check_one_of("demo", name, DEMOS)
    from mjlab.cli.flags import parse_flags
    from mjlab.scripts.play import PlayConfig, run_play

    demo = DEMOS[name]
    run_play(demo.task, parse_flags(PlayConfig, demo_cfg(demo), flags, prog=f"{prog} {name}"))


def main() -> None:
    """Entry point of `demo`."""
    run_alias("demo")


if __name__ == "__main__":
    main()
