"""Scoring a policy over many episodes."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Literal

from mjlab.scripts.cli import UserError, resolve_device
from mjlab.scripts.policy import constant_policy, find_checkpoint, load_policy, make_env
from mjlab.tasks.registry import load_rl_cfg


@dataclass
class EvaluateConfig:
    """Flags of `evaluate`."""

    agent: Literal["trained", "zero", "random"] = "trained"
    """Who acts: a trained policy, all-zero actions, or uniform ones in [-1, 1]."""
    checkpoint_file: str | None = None
    """Checkpoint to score; None takes the newest of the task."""
    wandb_run_path: str | None = None
    """Weights & Biases run to take the policy from, as entity/project/run."""
    wandb_checkpoint_name: str | None = None
    """Checkpoint of that run; None takes the newest."""
    num_episodes: int = 256
    """Episodes to play, one in each environment."""
    max_steps: int | None = None
    """Steps after which an episode is cut off; None is the task's episode length."""
    seed: int = 0
    """Seed of the evaluation."""
    device: str | None = None
    """Torch device; None takes a GPU where there is one."""
    engine: Literal["auto", "native", "warp"] | None = None
    """Physics engine."""
    json: bool = False
    """Print only JSON."""
    log_root: str = "logs/rsl_rl"
    """Folder of all runs."""


def run_evaluate(task: str, cfg: EvaluateConfig) -> dict[str, Any]:
    """Score a policy of `task`, print the figures, and return them.

    Episodes are those of the task's training config, whose time limit is part of the task.
    """
    from mjlab.rl.evaluate import evaluate_policy

    if cfg.num_episodes < 1:
        raise UserError(f"--num-episodes is {cfg.num_episodes}; at least 1 has to be played.")
    device = resolve_device(cfg.device)
    checkpoint = None
    if cfg.agent == "trained":
        checkpoint = find_checkpoint(
            task,
            cfg.log_root,
            cfg.checkpoint_file,
            cfg.wandb_run_path,
            cfg.wandb_checkpoint_name,
        )
    env = make_env(task, device, cfg.num_episodes, cfg.engine, play=False, seed=cfg.seed)
    solved = load_rl_cfg(task).evaluation
    target = solved.solved_return if solved.success_return is None else solved.success_return
    try:
        if checkpoint is None:
            policy = constant_policy(env, cfg.agent)
        else:
            policy = load_policy(task, env, checkpoint, device)
        result = evaluate_policy(
            env,
            policy,
            cfg.num_episodes,
            max_steps=cfg.max_steps,
            success_return=target,
            success_func=solved.success_func,
            seed=cfg.seed,
        )
        physics = env.unwrapped.sim.capabilities.description
    finally:
        env.close()
    figures = {
        "task": task,
        "policy": cfg.agent if checkpoint is None else str(checkpoint),
        "physics": physics,
        "seed": cfg.seed,
        **result.to_dict(),
    }
    print(json.dumps(figures, indent=2) if cfg.json else _table(figures, target))
    return figures


def _table(figures: dict[str, Any], target: float | None) -> str:
    low, high = figures["return_interval"]
    lines = [
        f"Task         {figures['task']}",
        f"Policy       {figures['policy']}",
        f"Physics      {figures['physics']}",
        f"Episodes     {figures['num_episodes']}, mean length {figures['mean_length']:.1f} steps",
        f"Mean return  {figures['mean_return']:.2f}   95 % interval [{low:.2f}, {high:.2f}]   "
        f"range [{figures['min_return']:.2f}, {figures['max_return']:.2f}]",
        "             (sum over the episode of the weighted reward before scaling by the time step)",
    ]
    if figures["success_rate"] is not None:
        low, high = figures["success_interval"]
        meaning = "" if target is None else f"   (return of at least {target:g})"
        lines.append(
            f"Success      {figures['success_rate']:.1%}   "
            f"95 % interval [{low:.1%}, {high:.1%}]{meaning}"
        )
    return "\n".join(lines)
