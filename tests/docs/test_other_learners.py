"""The code of `docs/guides/other_learners.md` is taken from the page and run."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("gymnasium")

PAGE = Path(__file__).resolve().parents[2] / "docs" / "guides" / "other_learners.md"


def blocks() -> dict[str, str]:
    """Return the page's Python code by the heading above it, a block after the other."""
    found: dict[str, str] = {}
    for part in re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]:
        heading, _, text = part.partition("\n")
        code = re.findall(r"^```python\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)
        found[heading] = "\n".join(code)
    return found


def test_environments_are_made_checked_and_stepped_by_a_loop():
    code = blocks()
    names: dict = {"np": np, "gamma": 0.9, "value": lambda final: np.full(len(final), 1000.0)}
    made = code["Gymnasium"].replace("Velocity-Flat-Unitree-Go1", "Cartpole-Swingup")
    exec(made.replace("=512", "=2").replace("1200", "1001"), names)
    envs = names["envs"]
    envs.reset(seed=1)
    names["actions"] = np.zeros(envs.action_space.shape, np.float32)
    for _ in range(1000):
        exec(code["Scripts like CleanRL's"], names)
    # Both ran out of time in the last step.
    assert (names["rewards"] > 899.0).all()
    assert names["dones"].all()
    envs.close()


def test_stable_baselines_takes_the_environment():
    pytest.importorskip("stable_baselines3")
    names: dict = {}
    code = blocks()["Stable-Baselines3"].replace("= 512", "= 4").replace("4096", "32")
    exec(code.replace("1_000_000", "1"), names)
    # One rollout.
    assert names["model"].num_timesteps == 4 * 32
