"""Search the gains of the stepping controller for a biped, by CMA-ES (Hansen, arXiv 1604.00772).

    uv run --with cma python examples/tune_stepping.py
    uv run --with cma python examples/tune_stepping.py --task My-Biped --frequency 1.5 --pushes 0.3

The task's `cpu` profile has the controller as the observation `teacher/step`. Every generation tries
`--population` sets of gains, each in as many environments as there is room for, and scores them by how long the robots
stand within `--seconds`, less their drift. The best gains are printed whenever they improve; give them to
`stepping_action`, or to the task's `Biped`, as `gains=SteppingGains(...)`. The defaults come from such a search for the
G1 over 25 gains, first without pushes (6 minutes on two cores) and then with 0.3 of them (8 minutes); gains that made no
difference were left out afterwards.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, fields
from typing import Any

import cma
import numpy as np
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.registry import load_env_cfg
from mjlab.tasks.velocity import mdp

NAMES = [field.name for field in fields(mdp.SteppingGains)]
START = np.array(list(asdict(mdp.SteppingGains()).values()))
SIZES = np.where(START == 0.0, 0.1, START)
"""Scales of the gains in the search."""


def make_env(task: str, num_envs: int, frequency: float, pushes: float) -> ManagerBasedRlEnv:
    """Return the task under its `cpu` profile, with reduced pushes."""
    cfg = load_env_cfg(task, profile="cpu")
    cfg.scene.num_envs, cfg.seed = num_envs, 0
    cfg.curriculum, cfg.rewards = {}, {}
    clock = cfg.commands["gait"]
    assert isinstance(clock, mdp.GaitClockCommandCfg)
    clock.frequency = frequency
    push = cfg.events["push_robot"]
    assert push is not None
    ranges = push.params["velocity_range"]
    for axis, (low, high) in ranges.items():
        ranges[axis] = (pushes * low, pushes * high)
    return ManagerBasedRlEnv(cfg, device="cpu")


def scores(env: ManagerBasedRlEnv, tried: np.ndarray, seconds: float) -> np.ndarray:
    """Return the score (sets,) of each set of gains (sets, gains): seconds until a fall, minus drift."""
    each = env.num_envs // len(tried)
    table = torch.tensor(tried, dtype=torch.float32).repeat_interleave(each, dim=0)
    own: dict[str, Any] = {name: table[:, [i]] for i, name in enumerate(NAMES)}
    gains = mdp.SteppingGains(**own)
    term = env.observation_manager.get_term_cfg("teacher", "step")
    params: dict[str, Any] = {**term.params, "gains": gains}
    act = mdp.stepping_action(term, env)
    data = env.scene["robot"].data
    env.reset()
    stands = torch.ones(env.num_envs, dtype=torch.bool)
    score = torch.zeros(env.num_envs)
    for _ in range(round(seconds / env.step_dt)):
        actions = act(env, **params)
        env.step(torch.where(actions.abs() < 1.0, actions, 0.0))
        stands &= ~env.reset_buf.bool()
        drift = data.root_link_lin_vel_b[:, :2].square().sum(dim=1).clamp(max=1.0)
        score += stands * (1.0 - 0.1 * drift) * env.step_dt
        if stands.float().mean() < 0.02:
            break
    return score.view(len(tried), each).mean(dim=1).numpy()


def search(
    env: ManagerBasedRlEnv, population: int, generations: int, seconds: float, seed: int
) -> mdp.SteppingGains:
    """Return the best gains of all generations; print those that improve."""
    strategy = cma.CMAEvolutionStrategy(
        np.zeros(len(NAMES)), 0.3, {"popsize": population, "seed": seed, "verbose": -9}
    )
    best, found = -np.inf, mdp.SteppingGains()
    for generation in range(generations):
        drawn = strategy.ask()
        tried = START + SIZES * np.array(drawn)
        values = scores(env, tried, seconds)
        strategy.tell(drawn, list(-values))
        print(
            f"{generation}: best {values.max():.2f} s, median {np.median(values):.2f} s", flush=True
        )
        if values.max() > best:
            best = values.max()
            found = mdp.SteppingGains(
                **dict(zip(NAMES, tried[values.argmax()].tolist(), strict=True))
            )
            print(found, flush=True)
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", default="Mjlab-Velocity-Flat-Unitree-G1")
    parser.add_argument("--frequency", type=float, default=1.88, help="strides per second")
    parser.add_argument("--pushes", type=float, default=0.0, help="part of the task's pushes")
    parser.add_argument("--population", type=int, default=24)
    parser.add_argument("--generations", type=int, default=30)
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--num-envs", type=int, default=1008)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    num_envs = args.num_envs // args.population * args.population
    env = make_env(args.task, num_envs, args.frequency, args.pushes)
    search(env, args.population, args.generations, args.seconds, args.seed)
