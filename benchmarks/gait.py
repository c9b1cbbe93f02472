"""Gaits of velocity policies beside each other: torque, power, slip, clearance, bobbing, action rate.

`python benchmarks/gait.py TASK POLICY [POLICY ...] [--profile cpu] [--episodes 60]` plays the same episodes
with each policy, a checkpoint or an exported policy (`.onnx`), as `evaluate` does, and prints a table.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "benchmarks")]

from falls import open_policy  # noqa: E402

from mjlab.rl.evaluation import EvaluationResult, evaluate_policy  # noqa: E402
from mjlab.tasks.registry import load_env_cfg  # noqa: E402
from mjlab.tasks.velocity.gait_metrics import GAIT_METRICS  # noqa: E402
from mjlab.tasks.velocity.rl.ppo import TRACKING_ERRORS  # noqa: E402

SEED = 1000
"""Seed of the episodes."""
METRICS = {**TRACKING_ERRORS, **GAIT_METRICS}


def measure(task: str, path: Path, profile: str | None, episodes: int) -> EvaluationResult:
    """Return the result of a policy over `episodes` episodes."""
    cfg = load_env_cfg(task, profile=profile, evaluate=True)
    cfg.scene.num_envs, cfg.seed = episodes, SEED
    env, policy = open_policy(task, path, profile, cfg)
    result = evaluate_policy(env, policy, metrics=METRICS, seed=SEED)
    env.close()
    return result


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("task")
    parser.add_argument("policies", type=Path, nargs="+", metavar="POLICY")
    parser.add_argument("--profile", help="profile used for training")
    parser.add_argument("--episodes", type=int, default=60)
    flags = parser.parse_args()
    print("| policy | falls |" + "".join(f" {name} |" for name in METRICS))
    print("| --- |" + " --- |" * (1 + len(METRICS)))
    for path in flags.policies:
        result = measure(flags.task, path, flags.profile, flags.episodes)
        values = "".join(f" {result.value(name):.3g} |" for name in METRICS)
        print(f"| {path.name} | {result.value('failure_rate'):.1%} |{values}", flush=True)


if __name__ == "__main__":
    main()
