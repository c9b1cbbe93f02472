"""Score of one policy on both engines: the demo's Go1, on the same 32 episodes.

Without a GPU, Warp runs on the CPU, in five minutes.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from measure import Row, output_of, show

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"
POLICY = Path(__file__).parents[1] / "src/mjlab/demo/go1_velocity.onnx"
NUM_EPISODES = 32


def evaluate(engine: str) -> dict[str, Any]:
    """Return what `evaluate --json True` prints."""
    command = [sys.executable, "-m", "mjlab.scripts.evaluate", TASK, "--engine", engine]
    command += ["--checkpoint-file", str(POLICY), "--num-episodes", str(NUM_EPISODES)]
    return json.loads(output_of([*command, "--json", "True"]))


def measure() -> list[Row]:
    """Return one row."""
    native, warp = evaluate("native"), evaluate("warp")
    low, high = native["return_interval"]
    return [
        Row(
            f"the demo's Go1 policy on Warp, {NUM_EPISODES} episodes",
            _shown(warp),
            f"native, the same episodes: {_shown(native)}",
            "return within the 95 % interval of native",
            low <= warp["mean_return"] <= high,
        )
    ]


def _shown(result: dict[str, Any]) -> str:
    low, high = result["return_interval"]
    errors = ", ".join(f"{name} {v['mean']:.3f}" for name, v in result["metrics"].items())
    return (
        f"return {result['mean_return']:.0f} [{low:.0f}, {high:.0f}]; {errors}; "
        f"{result['failure_rate']:.1%} failed"
    )


if __name__ == "__main__":
    print(show(measure()))
