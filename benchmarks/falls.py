"""Falls of a velocity policy: when they happen, and after which event.

`python benchmarks/falls.py TASK CHECKPOINT [--profile cpu] [--falls 200]` plays episodes of evaluations until
there are enough falls, and prints a table: the fraction of falls within a second of the start, of a push
and of a new command, by friction of the feet and by commanded speed, each beside the fraction of all steps
for which the same holds. A cause shows as a ratio well above 1.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "src")]

import torch  # noqa: E402

from mjlab.runs import Checkpoint, load_policy, make_env  # noqa: E402
from mjlab.runs.policy import agent_cfg_of  # noqa: E402
from mjlab.tasks.registry import load_env_cfg  # noqa: E402

NUM_ENVS = 400
"""Number of environments."""
RECENT_S = 1.0
"""Time after an event (s) in which a fall counts as its effect."""
SEED = 2000
"""Seed of the episodes."""


@dataclass
class Pushes:
    """Event function that pushes, and remembers the step of the last push of each environment."""

    push: Any
    last: torch.Tensor = field(default_factory=lambda: torch.full((NUM_ENVS,), -(10**6)))

    def __call__(self, env: Any, env_ids: torch.Tensor, **params: Any) -> None:
        self.last[env_ids] = env.common_step_counter
        self.push(env, env_ids, **params)


def measure(task: str, checkpoint: Path, profile: str | None, num_falls: int) -> dict[str, Any]:
    """Return counts of steps and falls for each circumstance, by name."""
    cfg = load_env_cfg(task, profile=profile, evaluate=True)
    cfg.scene.num_envs, cfg.seed = NUM_ENVS, SEED
    pushes = Pushes(cfg.events["push_robot"].func)
    cfg.events["push_robot"].func = pushes
    file = Checkpoint(checkpoint)
    env = make_env(task, cfg, "cpu", agent=agent_cfg_of(task, file, profile))
    policy = load_policy(task, env, file, "cpu", profile)
    unwrapped = env.unwrapped
    command = unwrapped.command_manager.get_term("twist")
    model = unwrapped.sim.mj_model
    (foot, *_) = [i for i in range(model.ngeom) if "foot" in model.geom(i).name]
    friction = unwrapped.sim.model.geom_friction[:, foot, 0].expand(NUM_ENVS)
    recent = round(RECENT_S / unwrapped.step_dt)
    last_command = torch.full((NUM_ENVS,), -(10**6))
    steps: dict[str, int] = {}
    falls: dict[str, int] = {}
    observations, _ = env.reset()
    left = command.time_left.clone()
    with torch.inference_mode():
        while falls.get("all", 0) < num_falls:
            ages = unwrapped.episode_length_buf.clone()
            now = unwrapped.common_step_counter
            speed = command.command[:, :2].norm(dim=-1).clone()
            is_new = command.time_left > left
            left = command.time_left.clone()
            last_command[is_new] = now
            age = {
                "start": ages,
                "push": now - pushes.last,
                "command": now - last_command,
            }
            holds = {"all": torch.ones(NUM_ENVS, dtype=torch.bool)}
            holds |= {f"{RECENT_S:g} s after {name}": a < recent for name, a in age.items()}
            holds["none of these"] = torch.stack([a >= recent for a in age.values()]).all(dim=0)
            for low, high in ((0.0, 0.45), (0.45, 0.7), (0.7, 2.0)):
                holds[f"friction {low} to {high}"] = (friction >= low) & (friction < high)
            for low, high in ((0.0, 0.1), (0.1, 0.7), (0.7, 2.0)):
                holds[f"commanded {low} to {high} m/s"] = (speed >= low) & (speed < high)
            observations, _, dones, _ = env.step(policy(observations))
            fell = dones.bool() & unwrapped.reset_terminated
            for name, one in holds.items():
                steps[name] = steps.get(name, 0) + int(one.sum())
                falls[name] = falls.get(name, 0) + int((one & fell).sum())
    env.close()
    return {"steps": steps, "falls": falls, "step_dt": unwrapped.step_dt}


def table(found: dict[str, Any]) -> str:
    """Return the table in Markdown."""
    steps, falls = found["steps"], found["falls"]
    lines = ["| circumstance | falls | share of falls | share of time | falls per minute |"]
    lines.append("| --- | --- | --- | --- | --- |")
    for name, count in falls.items():
        minutes = max(steps[name], 1) * found["step_dt"] / 60.0
        share, time = count / falls["all"], steps[name] / steps["all"]
        lines.append(
            f"| {name} | {count} | {share:.0%} | {time:.0%} | {count / minutes:.3f} |".replace(
                "%", " %"
            )
        )
    return "\n".join(lines)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("task")
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--profile")
    parser.add_argument("--falls", type=int, default=200)
    flags = parser.parse_args()
    print(table(measure(flags.task, flags.checkpoint, flags.profile, flags.falls)))


if __name__ == "__main__":
    main()
