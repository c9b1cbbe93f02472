"""Timing the steps of a task, and printing where the time goes."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from mjlab.scripts.cli import UserError, resolve_device
from mjlab.scripts.policy import (
    PolicyFlags,
    env_cfg_of,
    find_checkpoint,
    make_env,
    make_policy,
)

if TYPE_CHECKING:
    from mjlab.envs.profiling import StepProfile

# A term that takes more than this part of a step is worth a look.
_MUCH = 5.0


@dataclass
class ProfileConfig(PolicyFlags):
    """Flags of `profile-env`."""

    agent: Literal["zero", "random", "trained"] = "random"
    """Who acts: all-zero actions, uniform ones in [-1, 1], or a trained policy."""
    num_envs: int = 1024
    """Number of environments."""
    steps: int = 100
    """Environment steps to time."""
    warm_up: int = 20
    """Environment steps before that."""
    seed: int = 0
    """Seed of states and actions."""
    json: bool = False
    """Print only JSON."""


def run_profile_env(task: str, cfg: ProfileConfig) -> dict[str, Any]:
    """Time the steps of `task`, print the figures, and return them.

    The environment is that of the task's training config, at random points of its episodes, so
    that resets come as often as they do while training.
    """
    import torch

    from mjlab.envs.profiling import profiled_steps
    from mjlab.utils.torch import threads_for_policy

    for name, least in (("num_envs", 1), ("steps", 1), ("warm_up", 0)):
        if (value := getattr(cfg, name)) < least:
            flag = name.replace("_", "-")
            raise UserError(f"--{flag} is {value}; it has to be at least {least}.")
    device = resolve_device(cfg.device)
    checkpoint = find_checkpoint(task, cfg)
    env = make_env(
        task,
        env_cfg_of(task, cfg, checkpoint, purpose="train"),
        device,
        cfg.num_envs,
        cfg.engine,
        seed=cfg.seed,
        profile=cfg.profile,
    )
    try:
        policy = make_policy(task, env, cfg.agent, checkpoint, device, cfg.profile)
        lengths = env.episode_length_buf
        env.episode_length_buf = torch.randint_like(lengths, high=env.max_episode_length)
        with torch.inference_mode(), threads_for_policy(policy, cfg.num_envs, device):
            _step(env, policy, cfg.warm_up)
            seconds = _step(env, policy, cfg.steps)
            with profiled_steps(env.unwrapped) as profile:
                _step(env, policy, cfg.steps)
        physics = env.unwrapped.sim.capabilities.description
    finally:
        env.close()
    figures = {
        "task": task,
        "num_envs": cfg.num_envs,
        "physics": physics,
        "steps": cfg.steps,
        "step_ms": 1e3 * seconds / cfg.steps,
        **profile_figures(profile),
    }
    print(json.dumps(figures, indent=2) if cfg.json else _text(figures))
    return figures


def _step(env: Any, policy: Any, count: int) -> float:
    """Take `count` steps and return the seconds that stepping the environment took."""
    seconds = 0.0
    for _ in range(count):
        actions = policy(env.get_observations())
        _wait_for(env.device)
        begin = time.perf_counter()
        env.step(actions)
        _wait_for(env.device)
        seconds += time.perf_counter() - begin
    return seconds


def _wait_for(device: Any) -> None:
    if device.type == "cuda":
        import torch

        torch.cuda.synchronize(device)


def profile_figures(profile: StepProfile) -> dict[str, Any]:
    """Return a profile as milliseconds of a step and percent of it, the largest first."""

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


def _text(figures: dict[str, Any]) -> str:
    step, profiled = figures["step_ms"], figures["profiled_step_ms"]
    per_second = figures["num_envs"] / (step * 1e-3)
    lines = [
        f"Task     {figures['task']}, {figures['num_envs']} environments",
        f"Physics  {figures['physics']}",
        f"Step     {step:.3f} ms, {per_second:,.0f} environment steps per second; "
        f"{profiled:.3f} ms while timed in parts, over {figures['steps']} steps",
        "",
        *_table(("phase",), [((row["name"],), row) for row in figures["phases"]]),
        "",
        *_table(
            ("manager", "term"),
            [((row["manager"], row["name"]), row) for row in figures["terms"]],
        ),
        "",
        _note(figures["terms"]),
    ]
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


def _note(terms: list[dict[str, Any]]) -> str:
    much = [row for row in terms if row["percent"] > _MUCH]
    if not much:
        return f"No term takes more than {_MUCH:g} % of the step."
    names = (f"{row['manager']}/{row['name']} ({row['percent']:.1f} %)" for row in much)
    return f"More than {_MUCH:g} % of the step: {', '.join(names)}."
