"""Go1 on flat ground, trained on Warp until it is solved, and scored on episodes of unused seeds.

`train` uses the task's `cpu` profile, whose evaluations stop it, so results are comparable with
those of a few cores. The policy is then scored by `evaluate` on Warp, and on native MuJoCo, with
seeds that no evaluation of the training used.
"""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from measure import Row

from gpu_parts.options import Options
from gpu_parts.tasks import GO1_FLAT
from mjlab.cli.policy_flags import parse_policy_flags
from mjlab.rl.evaluation import EvaluationResult
from mjlab.scripts.evaluate import EvaluateConfig, run_evaluate
from mjlab.tasks.registry import load_rl_cfg

_PROFILE = "cpu"
_TRAINING_SEED, _FRESH_SEED = 1, 90_210
# Seconds reserved for scoring.
_FOR_SCORING = 60.0


def measure(options: Options) -> Iterator[Row]:
    """Train and score; yield two rows."""
    with tempfile.TemporaryDirectory() as folder:
        seconds, was_cut = _train(Path(folder), options)
        checkpoint = _newest_checkpoint(Path(folder))
        content = torch.load(checkpoint, map_location="cpu", weights_only=True)
        iterations = int(content["iterations_finished"])
        scores = {"warp": _score(checkpoint, "warp", options.device, options)}
        solved = _is_solved(scores["warp"]) and not was_cut
        ended = f"cut off after {seconds:.0f} s" if was_cut else f"{seconds:.0f} s"
        yield Row(
            f"{GO1_FLAT}, `--profile {_PROFILE}`, Warp: time from `train` until it stops because it "
            "is solved",
            f"{ended}, {iterations} iterations; {_shown(scores['warp'])}",
            f"scored by `evaluate` on {scores['warp'].num_episodes} episodes of fresh seeds",
            ", ".join(f"{name} below {most:g}" for name, most in _conditions().items()),
            solved if not options.tiny else None,
        )
        scores["native"] = _score(checkpoint, "native", "cpu", options)
        yield Row(
            "the same policy on native MuJoCo",
            _shown(scores["native"]),
            f"on Warp: {_shown(scores['warp'])}",
            "",
            None,
        )


def _train(log_root: Path, options: Options) -> tuple[float, bool]:
    """Train until the task is solved or the time is over; return the seconds, and whether cut off."""
    command = [sys.executable, "-m", "mjlab.scripts.train", GO1_FLAT, "--profile", _PROFILE]
    command += ["--device", options.device, "--engine", "warp", "--log-root", str(log_root)]
    command += ["--agent.seed", str(_TRAINING_SEED), "--agent.save-interval", "20"]
    if options.tiny:
        command += ["--num-envs", "2", "--agent.max-iterations", "1"]
    begin = time.monotonic()
    was_cut = False
    process = subprocess.Popen(command)
    try:
        try:
            process.wait(max(options.seconds - _FOR_SCORING, 0.5 * options.seconds))
        except subprocess.TimeoutExpired:
            # `train` saves on this signal.
            was_cut = True
            process.send_signal(signal.SIGINT)
            # If saving takes too long, the newest regular checkpoint is scored.
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(min(30.0, 0.25 * options.seconds))
    finally:
        process.kill()
        process.wait()
    if process.returncode != 0 and not was_cut:
        raise RuntimeError(f"{' '.join(command)} ended with {process.returncode}; see above.")
    return time.monotonic() - begin, was_cut


def _newest_checkpoint(log_root: Path) -> Path:
    checkpoints = sorted(log_root.glob("*/*/model_*.pt"), key=lambda path: path.stat().st_mtime)
    if not checkpoints:
        raise RuntimeError("Training was cut off before it had finished an iteration.")
    return checkpoints[-1]


def _score(checkpoint: Path, engine: str, device: str, options: Options) -> EvaluationResult:
    """Return the result of `evaluate`."""
    episodes = options.sized({"warp": 1000, "native": 256}, {"warp": 2, "native": 2})[engine]
    flags = ["--checkpoint-file", str(checkpoint), "--profile", _PROFILE, "--engine", engine]
    flags += ["--device", device, "--seed", str(_FRESH_SEED), "--num-episodes", str(episodes)]
    if options.tiny:
        flags += ["--max-steps", "3"]
    cfg = parse_policy_flags(EvaluateConfig, flags, GO1_FLAT, "evaluate", purpose="evaluate")
    return EvaluationResult.from_dict(run_evaluate(GO1_FLAT, cfg))


def _conditions() -> dict[str, float]:
    return dict(load_rl_cfg(GO1_FLAT, profile=_PROFILE).evaluation.solved_below)


def _is_solved(result: EvaluationResult) -> bool:
    # Judged as in training. Comparisons with NaN are False.
    return all(result.judged(name) <= most for name, most in _conditions().items())


def _shown(result: EvaluationResult) -> str:
    errors = ", ".join(f"{name} {result.value(name):.3f}" for name in _conditions())
    return f"{errors}; return {result.mean_return:.0f}"
