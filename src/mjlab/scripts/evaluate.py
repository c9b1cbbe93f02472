"""Evaluate a policy: `uv run mjlab evaluate TASK|POLICY [flags]`."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from mjlab.cli.devices import resolve_device
from mjlab.cli.flags import is_given
from mjlab.cli.main import run_alias
from mjlab.cli.policy_flags import (
    PolicyFlags,
    env_cfg_of,
    find_checkpoint,
    parse_policy_flags,
    report_policy,
    task_and_flags,
)
from mjlab.rl.checkpoint import curricula_of, naming_checkpoint
from mjlab.runs import Checkpoint
from mjlab.runs.policy import agent_cfg_of, has_foreign_runner, make_env, make_policy
from mjlab.tasks.registry import load_env_cfg
from mjlab.utils.logging import print_notice
from mjlab.utils.os import file_to_write, replacing
from mjlab.utils.ranges import Count, Seed, check_ranges
from mjlab.utils.screen import shown
from mjlab.utils.string import counted

_SECONDS_BETWEEN_DRAWINGS = 0.25
# Period of plain lines, for log files.
_SECONDS_BETWEEN_LINES = 10.0


@dataclass
class EvaluateConfig(PolicyFlags):
    """Flags of `evaluate`."""

    num_episodes: Count = field(default=256, metadata=shown("run", "N"))
    """Number of episodes; in rounds if --num-envs is lower."""
    num_envs: Count | None = field(default=None, metadata=shown("run", "N"))
    """Number of environments: episodes at once; short for --env.scene.num-envs. None: one environment
    per episode."""
    max_steps: Count | None = field(default=None, metadata=shown("run", "N"))
    """Maximum episode length in steps; longer episodes are truncated and not a success. None: episode
    length of evaluations."""
    seed: Seed | None = field(default=0, metadata=shown("run", "N"))
    """Seed of the evaluation."""
    json: bool = field(default=False, metadata=shown("run"))
    """Print only JSON."""
    output: str | None = field(default=None, metadata=shown("run", "FILE"))
    """File for the JSON, such as `evaluation.json` in the folder of the run, for pages and cards of
    the policy."""


def command(argv: list[str], prog: str) -> None:
    """Run `evaluate`."""
    task, flags = task_and_flags(argv)
    cfg = parse_policy_flags(EvaluateConfig, flags, task, prog, purpose="evaluate")
    run_evaluate(task, cfg, keep_num_envs=is_given("--env.scene.num-envs", flags))


def run_evaluate(task: str, cfg: EvaluateConfig, *, keep_num_envs: bool = False) -> dict[str, Any]:
    """Evaluate a policy of `task`, print the metrics, and return them.

    Environments are those of evaluations in training, because the time limit is part of the task. Their
    number is `cfg.num_envs`. If None, it is that of `cfg.env` if it differs from the task or if
    `keep_num_envs`, else `num_episodes`.
    """
    from mjlab.rl.evaluation import evaluate_policy, success_definition

    output = None if cfg.output is None else file_to_write(cfg.output)
    device = resolve_device(cfg.device)
    checkpoint = find_checkpoint(task, cfg)
    env_cfg = env_cfg_of(task, cfg, checkpoint, purpose="evaluate")
    settings = report_policy(task, checkpoint, cfg, env_cfg, "evaluate")
    default = load_env_cfg(task, profile=cfg.profile, evaluate=True).scene.num_envs
    if cfg.num_envs is None and not keep_num_envs and env_cfg.scene.num_envs == default:
        env_cfg.scene.num_envs = cfg.num_episodes
    agent = agent_cfg_of(task, checkpoint, cfg.profile)
    solved = agent.evaluation
    check_ranges(solved, (), "agent.evaluation")
    env = make_env(task, env_cfg, device, agent=agent)
    try:
        policy = make_policy(task, env, cfg.agent, checkpoint, device, cfg.profile)
        if checkpoint is not None:
            load_curricula_of(task, env, checkpoint)
        with EvaluationProgress(cfg.num_episodes) as progress:
            result = evaluate_policy(
                env,
                policy,
                cfg.num_episodes,
                max_steps=cfg.max_steps,
                success=solved.criterion,
                metrics=solved.metrics,
                standing_still=solved.standing_still,
                seed=cfg.seed,
                progress=progress.update,
            )
        failures = _failure_terms(env.unwrapped)
        physics = env.unwrapped.sim.capabilities.description
        num_envs = env.num_envs
    finally:
        env.close()
    metrics = {
        "task": task,
        "policy": cfg.agent if checkpoint is None else str(checkpoint),
        "physics": physics,
        "seed": cfg.seed,
        "num_envs": num_envs,
        "settings": settings,
        "success_definition": success_definition(solved),
        **result.to_dict(),
        "units": dict(solved.units),
    }
    text = json.dumps(metrics, indent=2)
    print(text if cfg.json else _table(metrics, failures))
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        with replacing(output) as file:
            file.write(f"{text}\n".encode())
    return metrics


def load_curricula_of(task: str, env: Any, checkpoint: Checkpoint) -> None:
    """Restore the curricula of the policy's run; print a line if their state is unknown."""
    from mjlab.rl.evaluation import load_curricula

    is_ours = checkpoint.path.suffix == ".pt" and not has_foreign_runner(task)
    state = curricula_of(checkpoint.content) if is_ours else None
    with naming_checkpoint(checkpoint):
        left_out = [] if state is None else load_curricula(env, state)
    unwrapped = env.unwrapped
    if not unwrapped.curriculum_manager.active_terms:
        return
    if state is None:
        # Loading a checkpoint sets the counter.
        steps = unwrapped.common_step_counter
        print_notice(
            f"{checkpoint.path.name} does not hold the state of the task's curricula: they are at their "
            + (f"state after {counted(steps, 'step')}." if steps else "beginning.")
        )
    elif left_out:
        print_notice(f"Curricula of {checkpoint.path.name} not restored: {', '.join(left_out)}.")


class EvaluationProgress:
    """Progress of an evaluation on stderr: a bar on a terminal, elsewhere a line now and then."""

    def __init__(self, num_episodes: int, console: Console | None = None) -> None:
        self._num_episodes = num_episodes
        self._bar = Progress(
            TextColumn("Evaluating"),
            BarColumn(24),
            TextColumn("{task.fields[done]} of " + counted(num_episodes, "episode")),
            TimeRemainingColumn(),
            console=console or Console(stderr=True),
            transient=True,
            auto_refresh=False,
        )
        self._task = self._bar.add_task("", total=1.0, done=0)
        self._last = time.perf_counter()

    def __enter__(self) -> EvaluationProgress:
        if self._bar.console.is_interactive:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def update(self, num_finished: int, fraction: float) -> None:
        """Show the number of finished episodes, and the fraction of the evaluation that is done."""
        draws = self._bar.console.is_interactive
        self._bar.update(self._task, completed=fraction, done=num_finished)
        now = time.perf_counter()
        if now - self._last < (_SECONDS_BETWEEN_DRAWINGS if draws else _SECONDS_BETWEEN_LINES):
            return
        self._last = now
        if draws:
            self._bar.refresh()
        else:
            episodes = counted(self._num_episodes, "episode")
            print_notice(f"Evaluating: {fraction:.0%}, {num_finished} of {episodes} finished")


def _failure_terms(env: Any) -> list[str]:
    """Return the terminations that are failures, not time limits."""
    manager = env.termination_manager
    return [name for name in manager.active_terms if not manager.get_term_cfg(name).time_out]


def _table(metrics: dict[str, Any], failures: list[str]) -> str:
    """Format the metrics; `failures` are the terminations that count as failures."""
    from mjlab.rl.evaluation import SHARE, curricula_text

    lines = [
        f"Task         {metrics['task']}",
        f"Policy       {metrics['policy']}",
        f"Physics      {metrics['physics']}",
        f"Episodes     {metrics['num_episodes']:,} in {counted(metrics['num_envs'], 'environment')}, "
        f"mean length {metrics['mean_length']:.1f} steps",
        f"Mean return  {metrics['mean_return']:.2f}   {_interval(metrics['return_interval'], '.2f')}"
        f"   range [{metrics['min_return']:.2f}, {metrics['max_return']:.2f}]",
        "             (sum over the episode of the weighted reward before scaling by the time step)",
    ]
    if metrics["success_rate"] is not None:
        lines.append(
            f"Success      {metrics['success_rate']:.1%}   "
            f"{_interval(metrics['success_interval'], '.1%')}   ({metrics['success_definition']})"
        )
    if not failures and not metrics["failure_rate"]:
        lines.append("Failures     none: the task has no termination but time limits")
    elif metrics["failure_rate"] is not None:
        rates = {name: metrics["terminations"].get(name) for name in failures}
        ended = ", ".join(f"{name} {rate:.1%}" for name, rate in rates.items() if rate)
        # Diverged episodes fail without a termination.
        ended = ended or ("diverged physics" if metrics["failure_rate"] else "")
        lines.append(
            f"Failures     {metrics['failure_rate']:.1%}   "
            f"{_interval(metrics['failure_interval'], '.1%')}"
            + (f"   (ended by: {ended})" if ended else "")
        )
    measured, still = metrics["metrics"], metrics["standing_still"]
    for name, value in measured.items():
        if name.removesuffix(SHARE) in still and name not in still:
            continue
        unit = metrics["units"].get(name, "")
        line = f"{name:<12} {value['mean']:.4g} {unit}".rstrip()
        line += f"   {_interval(value['interval'], '.4g')}"
        if name in still:
            # Standing still is no yardstick where it has no error.
            share = measured.get(f"{name}{SHARE}")
            of = f"{share['mean']:.0%} of " if share else ""
            line += f"   ({of}standing still, {f'{still[name]:.4g} {unit}'.rstrip()})"
        lines.append(line)
    if state := curricula_text(metrics["curricula"]):
        lines.append(f"Curricula    {state}")
    lines += [f"Note         {note}" for note in metrics["notes"]]
    return "\n".join(lines)


def _interval(bounds: Sequence[float] | None, form: str) -> str:
    if bounds is None:
        return "no interval"
    low, high = bounds
    return f"95 % interval [{low:{form}}, {high:{form}}]"


def main() -> None:
    """Entry point of `evaluate`."""
    run_alias("evaluate")


if __name__ == "__main__":
    main()
