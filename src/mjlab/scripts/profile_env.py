"""Profile the environment step of a task: `uv run mjlab profile-env TASK [flags]`."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any, Literal

import torch

from mjlab.cli.devices import resolve_device
from mjlab.cli.main import run_alias
from mjlab.cli.policy_flags import (
    PolicyFlags,
    env_cfg_of,
    find_checkpoint,
    parse_policy_flags,
    report_policy,
)
from mjlab.compat import older_names
from mjlab.envs.profiling import StepProfile, device_time, profiled_steps
from mjlab.runs.policy import agent_cfg_of, make_env, make_policy
from mjlab.utils.ranges import Count, CountOrZero, Seed
from mjlab.utils.screen import shown
from mjlab.utils.string import counted
from mjlab.utils.torch import threads_for_policy

__getattr__ = older_names(__name__)

# Share of the step time (%) above which a term is reported as expensive.
_EXPENSIVE = 5.0


@dataclass
class ProfileConfig(PolicyFlags):
    """Flags of `profile-env`."""

    agent: Literal["zero", "random", "trained"] = field(
        default="random", metadata=shown("policy", "trained|zero|random")
    )
    """Policy: `zero` actions, `random` uniform actions in [-1, 1], or a `trained` policy."""
    num_envs: Count | None = field(default=1024, metadata=shown("run", "N"))
    """Number of environments."""
    steps: Count = field(default=100, metadata=shown("run", "N"))
    """Environment steps to time."""
    warm_up: CountOrZero = field(default=20, metadata=shown("run", "N"))
    """Environment steps before timing."""
    seed: Seed | None = field(default=0, metadata=shown("run", "N"))
    """Seed of states and actions."""
    json: bool = field(default=False, metadata=shown("run"))
    """Print only JSON."""


def command(argv: list[str], prog: str) -> None:
    """Run `profile-env`."""
    task, *flags = argv
    cfg = parse_policy_flags(ProfileConfig, flags, task, prog, purpose="train")
    run_profile_env(task, cfg)


def run_profile_env(task: str, cfg: ProfileConfig) -> dict[str, Any]:
    """Time the steps of `task`, print the times, and return them.

    Environments use the training config and start at random episode times, so that resets are as
    frequent as in training.
    """
    device = resolve_device(cfg.device)
    checkpoint = find_checkpoint(task, cfg)
    env_cfg = env_cfg_of(task, cfg, checkpoint, purpose="train")
    report_policy(task, checkpoint, cfg, env_cfg, "train")
    agent = agent_cfg_of(task, checkpoint, cfg.profile)
    env = make_env(task, env_cfg, device, agent=agent)
    try:
        policy = make_policy(task, env, cfg.agent, checkpoint, device, cfg.profile)
        lengths = env.episode_length_buf
        env.episode_length_buf = torch.randint_like(lengths, high=env.max_episode_length)
        with torch.inference_mode(), threads_for_policy(policy, env.num_envs, device):
            _step(env, policy, cfg.warm_up)
            seconds = _step(env, policy, cfg.steps)
            with profiled_steps(env.unwrapped) as profile:
                _step(env, policy, cfg.steps)
        physics = env.unwrapped.sim.capabilities.description
    finally:
        env.close()
    times = {
        "task": task,
        "num_envs": env.num_envs,
        "physics": physics,
        "steps": cfg.steps,
        "step_ms": 1e3 * seconds / cfg.steps,
        **profile_rows(profile),
    }
    print(json.dumps(times, indent=2) if cfg.json else _format_times(times))
    return times


def _step(env: Any, policy: Any, count: int) -> float:
    """Take `count` steps and return the time spent in `env.step` (s)."""
    seconds = 0.0
    for _ in range(count):
        actions = policy(env.get_observations())
        begin = device_time(env.device)
        env.step(actions)
        seconds += device_time(env.device) - begin
    return seconds


def profile_rows(profile: StepProfile) -> dict[str, Any]:
    """Return a profile in milliseconds per step and percent of the step, largest first."""

    def row(seconds: float, **names: str) -> dict[str, Any]:
        return {**names, "ms": profile.milliseconds(seconds), "percent": profile.percent(seconds)}

    def sorted_rows(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return sorted(rows, key=lambda row: -row["ms"])

    phases = {**profile.phases, "other": profile.other}
    return {
        "profiled_step_ms": profile.milliseconds(profile.step_time),
        "phases": sorted_rows([row(seconds, name=name) for name, seconds in phases.items()]),
        "terms": sorted_rows(
            [
                row(seconds, manager=manager, name=name)
                for manager, terms in profile.terms.items()
                for name, seconds in terms.items()
            ]
        ),
    }


def _format_times(times: dict[str, Any]) -> str:
    step, profiled = times["step_ms"], times["profiled_step_ms"]
    per_second = times["num_envs"] / (step * 1e-3)
    lines = [
        f"Task     {times['task']}, {counted(times['num_envs'], 'environment')}",
        f"Physics  {times['physics']}",
        f"Step     {step:.3f} ms, {per_second:,.0f} environment steps per second; "
        f"{profiled:.3f} ms while timed in parts, over {times['steps']} steps",
        "",
        *_table(("phase",), [((row["name"],), row) for row in times["phases"]]),
        "",
        *_table(
            ("manager", "term"),
            [((row["manager"], row["name"]), row) for row in times["terms"]],
        ),
        "",
    ]
    expensive = [row for row in times["terms"] if row["percent"] > _EXPENSIVE]
    names = (f"{row['manager']}/{row['name']} ({row['percent']:.1f} %)" for row in expensive)
    if expensive:
        lines.append(f"More than {_EXPENSIVE:g} % of the step: {', '.join(names)}.")
    else:
        lines.append(f"No term takes more than {_EXPENSIVE:g} % of the step.")
    return "\n".join(lines)


def _table(
    header: tuple[str, ...], rows: list[tuple[tuple[str, ...], dict[str, Any]]]
) -> list[str]:
    widths = [
        max(len(names[column]) for names in (header, *(names for names, _ in rows)))
        for column in range(len(header))
    ]

    def line(names: tuple[str, ...], ms: str, percent: str) -> str:
        cells = [f"{name:<{width}}" for name, width in zip(names, widths, strict=True)]
        return "  ".join([*cells, f"{ms:>9}", f"{percent:>6}"])

    lines = [line(header, "ms", "%")]
    return lines + [line(names, f"{row['ms']:.3f}", f"{row['percent']:.1f}") for names, row in rows]


def main() -> None:
    """Entry point of `profile-env`."""
    run_alias("profile-env")


if __name__ == "__main__":
    main()
