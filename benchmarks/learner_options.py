"""Time of updates in bfloat16 and with `torch.compile`, Go1 flat on the CPU.

PPO has the settings of the profile `cpu`, and those of the task's own networks; SAC its defaults. Runs take turns
of two iterations.
"""

from __future__ import annotations

import statistics
from dataclasses import asdict
from typing import Any

from measure import Row, show

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.rl.run_logger import IterationStats, TrainingObserver
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.utils.torch import prepare_torch

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"
ROUNDS, TURN, NUM_ENVS = 6, 2, 512
_PPO_VARIANTS: dict[str, dict[str, Any]] = {
    "float32": {},
    "bfloat16": {"use_mixed_precision": True},
    "compiled": {"torch_compile_mode": "default"},
    "bfloat16, compiled": {"use_mixed_precision": True, "torch_compile_mode": "default"},
}
# Learner, profile and config changes, by name. The first of each learner is the baseline.
CASES: dict[str, tuple[tuple[str, str | None], dict[str, dict[str, Any]]]] = {
    "PPO, 128-64": (("ppo", "cpu"), _PPO_VARIANTS),
    "PPO, 512-256-128": (("ppo", None), _PPO_VARIANTS),
    "SAC, 256-128-64": (
        ("sac", None),
        {"float32": {}, "bfloat16": {"use_mixed_precision": True}},
    ),
}


class _Times(TrainingObserver):
    """Seconds of all iterations except those of the first turn (warm-up).

    PPO: seconds of updates. SAC learns between steps: seconds of whole iterations.
    """

    def __init__(self, learner: str) -> None:
        self.seconds: list[float] = []
        self._learner = learner

    def on_iteration(self, stats: IterationStats) -> None:
        if stats.iteration > TURN:
            steps = stats.collection_time if self._learner == "sac" else 0.0
            self.seconds.append(steps + stats.learning_time)


def measure() -> list[Row]:
    """Measure all cases."""
    prepare_torch("cpu")
    return [row for name in CASES for row in _measure(name)]


def _measure(name: str) -> list[Row]:
    (learner, profile), variants = CASES[name]
    runners = {variant: _runner(learner, profile, edits) for variant, edits in variants.items()}
    times = {variant: _Times(learner) for variant in variants}
    for variant, runner in runners.items():
        runner.observers.append(times[variant])
    for round_ in range(1, ROUNDS + 1):
        for runner in runners.values():
            runner.learn(TURN * round_)
    medians = {variant: statistics.median(times[variant].seconds) for variant in variants}
    plain, *others = variants
    for runner in runners.values():
        runner.env.close()
    return [
        Row(
            f"{name}, {NUM_ENVS} environments: time of "
            f"{'an iteration' if learner == 'sac' else 'its updates'}, {variant}",
            f"{medians[variant] / medians[plain]:.2f} ({medians[variant]:.3f} s)",
            f"{plain}: {medians[plain]:.3f} s",
            "",
            None,
        )
        for variant in others
    ]


def _runner(learner: Any, profile: str | None, edits: dict[str, Any]) -> MjlabOnPolicyRunner:
    env_cfg = load_env_cfg(TASK, profile=profile)
    env_cfg.scene.num_envs = NUM_ENVS
    cfg: Any = load_rl_cfg(TASK, profile=profile, learner=learner)
    cfg.evaluation.solved_below = {}
    for name, value in edits.items():
        setattr(cfg if hasattr(cfg, name) else cfg.algorithm, name, value)
    env = RslRlVecEnvWrapper(ManagerBasedRlEnv(env_cfg, device="cpu"))
    runner = MjlabOnPolicyRunner(env, asdict(cfg))
    algorithm: Any = runner.alg
    if learner == "sac":
        # Sequential: in parallel with the physics, updates show only if they take longer.
        algorithm._is_concurrent = False
    return runner


if __name__ == "__main__":
    print(show(measure()))
