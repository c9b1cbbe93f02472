"""Falls of a velocity policy: when they happen, and after which event.

`python benchmarks/falls.py TASK CHECKPOINT [--profile cpu] [--falls 200] [--minutes 4]` plays episodes as
`evaluate` does until there are enough falls, at most `--minutes` of simulated time in each environment, and
prints a table of circumstances: shortly after the start, a push or a new command, by friction of the feet and
by commanded speed. The ratio is the share of falls that happen in a circumstance to its share of time: well
above 1 for a cause, 1 for a circumstance that does not matter.
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

from mjlab.envs import ManagerBasedRlEnvCfg  # noqa: E402
from mjlab.rl.checkpoint import curricula_of  # noqa: E402
from mjlab.rl.evaluation import load_curricula  # noqa: E402
from mjlab.runs import Checkpoint, load_policy, make_env  # noqa: E402
from mjlab.runs.policy import agent_cfg_of  # noqa: E402
from mjlab.tasks.registry import load_env_cfg  # noqa: E402

NUM_ENVS = 400
"""Number of environments."""
RECENT_S = 1.0
"""Time after an event (s) in which a fall counts as its effect."""
SEED = 2000
"""Seed of the episodes."""
FRICTIONS = ((0.0, 0.45), (0.45, 0.7), (0.7, 2.0))
"""Ranges of the sliding friction of the feet."""
SPEEDS = ((0.0, 0.1), (0.1, 0.7), (0.7, 3.0))
"""Ranges of the commanded speed (m/s)."""
_NEVER = 10**9


@dataclass
class Falls:
    """Numbers of steps and of falls, by circumstance. `all` is the first."""

    step_dt: float
    """Duration of a step (s)."""
    steps: dict[str, int] = field(default_factory=dict)
    """Steps of all environments in each circumstance."""
    falls: dict[str, int] = field(default_factory=dict)
    """Falls in each circumstance."""

    def add(self, circumstances: dict[str, torch.Tensor], fell: torch.Tensor) -> None:
        """Count a step: masks of the environments in each circumstance before it, and of falls in it."""
        for name, holds in circumstances.items():
            self.steps[name] = self.steps.get(name, 0) + int(holds.sum())
            self.falls[name] = self.falls.get(name, 0) + int((holds & fell).sum())

    @property
    def total(self) -> int:
        """Number of falls."""
        return self.falls.get("all", 0)

    def __str__(self) -> str:
        """Table in Markdown."""
        minutes = self.steps["all"] * self.step_dt / 60.0
        lines = [
            f"{self.total} falls in {minutes:,.1f} minutes, summed over environments: "
            f"{self.total / minutes:.3f} per minute",
            "",
            "| circumstance | share of time | falls | share of falls | ratio |",
            "| --- | --- | --- | --- | --- |",
        ]
        for name, falls in self.falls.items():
            time, share, ratio = self.steps[name] / self.steps["all"], "", ""
            if self.total:
                share = f"{100.0 * falls / self.total:.0f} %"
                ratio = f"{falls / self.total / time:.2f}" if time else ""
            lines.append(f"| {name} | {100.0 * time:.0f} % | {falls} | {share} | {ratio} |")
        return "\n".join(lines)


def time_pushes(cfg: ManagerBasedRlEnvCfg) -> torch.Tensor | None:
    """Let the event `push_robot` zero a counter of each environment; return the counters, (NUM_ENVS,) int64.

    None: the task does not push.
    """
    if "push_robot" not in cfg.events:
        return None
    age = torch.full((NUM_ENVS,), _NEVER)
    push = cfg.events["push_robot"].func

    # A function, because copies of a config share functions and copy objects.
    def push_and_zero(env: Any, env_ids: torch.Tensor, **params: Any) -> None:
        age[env_ids] = 0
        push(env, env_ids, **params)

    cfg.events["push_robot"].func = push_and_zero
    return age


def foot_friction(env: Any) -> torch.Tensor:
    """Return the sliding friction of the feet of each environment, (NUM_ENVS,). Feet share it."""
    event = next(term for name, term in env.cfg.events.items() if name.startswith("foot_friction"))
    robot = env.scene["robot"]
    feet, _ = robot.find_geoms(event.params["asset_cfg"].geom_names)
    geom = robot.indexing.geom_ids[feet[0]]
    return env.sim.model.geom_friction[:, geom, 0].expand(NUM_ENVS)


def within(values: torch.Tensor, bounds: tuple[float, float]) -> torch.Tensor:
    """Return the mask of `values` in a half-open range."""
    return (values >= bounds[0]) & (values < bounds[1])


def open_policy(
    task: str, path: Path, profile: str | None, cfg: ManagerBasedRlEnvCfg
) -> tuple[Any, Any]:
    """Return the environments of `cfg`, with the curricula of a checkpoint, and the policy in `path`."""
    checkpoint = Checkpoint(path)
    env = make_env(task, cfg, "cpu", agent=agent_cfg_of(task, checkpoint, profile))
    policy = load_policy(task, env, checkpoint, "cpu", profile)
    # Exported policies have no curricula.
    if path.suffix != ".onnx" and (curricula := curricula_of(checkpoint.content)) is not None:
        load_curricula(env, curricula)
    return env, policy


def measure(task: str, path: Path, profile: str | None, num_falls: int, minutes: float) -> Falls:
    """Play episodes of `task` until `num_falls` falls, at most `minutes` of simulated time.

    All environments play for whole episode lengths, so that each time of an episode has its share.
    """
    cfg = load_env_cfg(task, profile=profile, evaluate=True)
    cfg.scene.num_envs, cfg.seed = NUM_ENVS, SEED
    push_age = time_pushes(cfg)
    wrapped, policy = open_policy(task, path, profile, cfg)
    env = wrapped.unwrapped
    terrain = env.scene.terrain
    if terrain is not None and terrain.terrain_levels is not None:
        terrain.spread_levels()
    twist = env.command_manager.get_term("twist")
    found = Falls(env.step_dt)
    command_age = torch.full((NUM_ENVS,), _NEVER)
    ages = {"a new command": command_age} | ({} if push_age is None else {"a push": push_age})
    with torch.inference_mode(), env.curricula_held():
        observations, _ = wrapped.reset()
        friction = foot_friction(env).clone()
        for step in range(max(1, round(60.0 * minutes / env.step_dt))):
            if step > 0 and step % env.max_episode_length == 0:
                print(f"{step * env.step_dt:.0f} s: {found.total} falls", file=sys.stderr)
                if found.total >= num_falls:
                    break
            since = {"the start": env.episode_length_buf, **ages}
            recent = {name: age * env.step_dt < RECENT_S for name, age in since.items()}
            speed = twist.command[:, :2].norm(dim=-1)
            circumstances = {
                "all": torch.ones(NUM_ENVS, dtype=torch.bool),
                **{f"{RECENT_S:g} s after {name}": mask for name, mask in recent.items()},
                "after none of these": ~torch.stack([*recent.values()]).any(dim=0),
                **{f"friction {b[0]:g} to {b[1]:g}": within(friction, b) for b in FRICTIONS},
                **{f"commanded {b[0]:g} to {b[1]:g} m/s": within(speed, b) for b in SPEEDS},
            }
            commands = twist.command_counter.clone()
            for age in ages.values():
                age += 1
            observations, _, dones, _ = wrapped.step(policy(observations))
            found.add(circumstances, env.reset_terminated)
            command_age[twist.command_counter > commands] = 0
            for age in ages.values():
                age[dones.bool()] = _NEVER
    wrapped.close()
    return found


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("task")
    parser.add_argument("checkpoint", type=Path, help="model_<iteration>.pt")
    parser.add_argument("--profile", help="profile used for training")
    parser.add_argument("--falls", type=int, default=200)
    parser.add_argument("--minutes", type=float, default=4.0, help="simulated, at most")
    flags = parser.parse_args()
    print(measure(flags.task, flags.checkpoint, flags.profile, flags.falls, flags.minutes))


if __name__ == "__main__":
    main()
