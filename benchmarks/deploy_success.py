"""Success of a deployed policy in plain MuJoCo against its environment: same starts, same commands.

The environment, without noise, pushes, delays and randomization, records starts and commands. The bundle's
`runtime.py` and `simulate.py` then play the same episodes with `mj_step`. One rule judges the states of both
(`deploy_judges.py`): a walker does not fall; an arm has its hand, or the object, at the goal in the last
step; a robot that tracks a motion is not ended by a failure of its task.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from deploy_judges import Judge, Outcome, Start, judge_of

from mjlab.cli.policy_flags import env_cfg_of, find_checkpoint, parse_policy_flags
from mjlab.deploy.evidence import Programs
from mjlab.deploy.golden import STATE
from mjlab.deploy.nominal import nominal_cfg
from mjlab.deploy.usual_terms import is_velocity
from mjlab.rl.exporter_utils import OnnxPolicy
from mjlab.runs.policy import agent_cfg_of, make_env
from mjlab.scripts.deploy import DeployConfig, policy_of, run_deploy

NORMAL = 1.96
"""Half-width of a 95 % interval, in standard errors."""


@dataclass(frozen=True)
class Episodes:
    """Episodes of the environment."""

    starts: list[Start]
    """Start of each episode."""
    steps: int
    """Control steps T of an episode."""
    commands: dict[str, np.ndarray]
    """Given commands by name, (T, N, size)."""
    outcomes: list[Outcome]
    """Outcome of each episode."""

    def command(self, k: int) -> dict[str, np.ndarray]:
        """Return the given commands of episode `k`, (T, size)."""
        return {name: values[:, k] for name, values in self.commands.items()}


def in_environment(
    env: Any, contract: dict[str, Any], policy: OnnxPolicy, judge: Judge, steps: int
) -> Episodes:
    """Play one episode in each environment."""
    names = [one["name"] for one in contract["commands"] if one["kind"] == "given"]
    commands: dict[str, list[np.ndarray]] = {name: [] for name in names}
    states, clip = [], contract["policy"]["clip"]
    with env.curricula_held(), torch.no_grad():
        observations, _ = env.reset()
        policy.reset()
        starts = starts_of(env)
        for _ in range(steps):
            for name in names:
                commands[name].append(env.command_manager.get_command(name).cpu().numpy().copy())
            action = policy(observations)
            observations, *_ = env.step(action if clip is None else action.clamp(-clip, clip))
            # Copies: these are views of simulation memory.
            states.append(
                [x.cpu().double().numpy() for x in (env.sim.data.qpos, env.sim.data.qvel)]
            )
    qpos, qvel = (np.array([row[field] for row in states]) for field in (0, 1))
    stacked = {name: np.array(rows) for name, rows in commands.items()}
    episodes = Episodes(starts, steps, stacked, [])
    for k, start in enumerate(starts):
        outcome = judge.outcome(start, qpos[:, k], qvel[:, k], episodes.command(k))
        episodes.outcomes.append(outcome)
    return episodes


def starts_of(env: Any) -> list[Start]:
    """Return the starts of all environments, after their reset."""
    host, starts = mujoco.MjData(env.sim.mj_model), []
    terms = map(env.command_manager.get_term, env.command_manager.active_terms)
    motion = next((term for term in terms if hasattr(term, "motion_ids")), None)
    for k in range(env.num_envs):
        env.sim.copy_to_host(k, host)
        state = {field: np.array(getattr(host, field)) for field in STATE}
        if motion is None:
            starts.append(Start(state))
            continue
        index, t = int(motion.motion_ids[k]), int(motion.time_steps[k])
        first, length = int(motion.motion.starts[index]), int(motion.motion.lengths[index])
        starts.append(Start(state, index, first + t, length - 1 - t))
    return starts


def in_mujoco(bundle: Path, episodes: Episodes, judge: Judge) -> list[Outcome]:
    """Play the same episodes by the programs of the bundle."""
    programs = Programs.load(bundle)
    policy = programs.runtime.Policy.load(bundle)
    simulation = programs.simulate.Simulation(policy.contract, programs.simulate.load_model(bundle))
    outcomes = []
    for k, start in enumerate(episodes.starts):
        simulation.reset()
        simulation.set_state(**start.state)
        policy.reset(start.motion)
        # Of a motion: the step goes to the next frame.
        policy.frame = start.frame - 1
        commands, states = episodes.command(k), []
        for t in range(min(episodes.steps, start.length)):
            command = {name: values[t] for name, values in commands.items()}
            simulation.apply(policy.step(simulation.measure(), command))
            states.append((simulation.data.qpos.copy(), simulation.data.qvel.copy()))
        qpos, qvel = (np.array([row[field] for row in states]) for field in (0, 1))
        outcomes.append(judge.outcome(start, qpos, qvel, commands))
    return outcomes


def difference_of_success(one: list[bool], other: list[bool]) -> tuple[float, float, float]:
    """Return the paired difference of success rates, and its 95 % interval (Agresti and Min, 2005).

    With half a pair added to each cell of the table, the interval has a width also without differences.
    """
    pairs = list(zip(one, other, strict=True))
    only_one, only_other = (sum(a > b for a, b in pairs) + 0.5, sum(a < b for a, b in pairs) + 0.5)
    count = len(pairs) + 2
    shift = (only_other - only_one) / count
    spread = NORMAL * math.sqrt((only_one + only_other) / count - shift**2) / math.sqrt(count)
    return float(np.mean(other) - np.mean(one)), shift - spread, shift + spread


def show(episodes: Episodes, played: list[Outcome], quantity: str) -> None:
    """Print success rates, mean errors, and their paired differences."""
    pairs = list(zip(episodes.outcomes, played, strict=True))
    success = [a.succeeds for a, _ in pairs], [b.succeeds for _, b in pairs]
    rates = [100.0 * float(np.mean(one)) for one in success]
    print(f"success in the environment {rates[0]:.1f} %, in plain MuJoCo {rates[1]:.1f} %")
    by, low, high = (100.0 * x for x in difference_of_success(*success))
    print(f"paired difference {by:+.1f} points, 95 % interval {low:+.1f} to {high:+.1f}")
    errors = np.array([(a.error, b.error) for a, b in pairs])
    errors = errors[np.isfinite(errors).all(axis=1)]
    if len(errors) > 1:
        change = errors[:, 1] - errors[:, 0]
        half = NORMAL * change.std(ddof=1) / math.sqrt(len(change))
        print(
            f"{quantity} {errors[:, 0].mean():.4f} and {errors[:, 1].mean():.4f}; paired "
            f"difference {change.mean():+.5f}, 95 % interval {change.mean() - half:+.5f} to "
            f"{change.mean() + half:+.5f}"
        )


def main() -> None:
    """Play the episodes and print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", help="go1 or g1 (bundled policies), run folder, or checkpoint")
    parser.add_argument("--pairs", type=int, default=100, help="episodes")
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of an episode")
    parser.add_argument("--bundle", help="folder that `mjlab deploy` wrote from the policy")
    options = parser.parse_args()
    task, flags = policy_of(options.policy)
    with tempfile.TemporaryDirectory() as temporary:
        bundle = Path(options.bundle or f"{temporary}/bundle")
        flags += ["--output", str(bundle), "--steps", "100"]
        cfg = parse_policy_flags(DeployConfig, flags, task, "deploy", purpose="evaluate")
        if options.bundle is None:
            run_deploy(task, cfg)
        contract = json.loads((bundle / "contract.json").read_text(encoding="utf-8"))
        start, seconds = time.perf_counter(), longest(contract, options.seconds)
        env = nominal_env(task, cfg, options.pairs)
        judge = judge_of(env.unwrapped, contract, bundle)
        steps = round(seconds / contract["rates"]["step_dt"])
        policy = OnnxPolicy(bundle / contract["policy"]["file"], num_envs=options.pairs)
        episodes = in_environment(env.unwrapped, contract, policy, judge, steps)
        env.close()
        played_from = time.perf_counter()
        played = in_mujoco(bundle, episodes, judge)
    ended = time.perf_counter()
    print(f"{task}: {options.pairs} pairs of {seconds:g} s, ", end="")
    print(f"{played_from - start:.0f} s and {ended - played_from:.0f} s")
    show(episodes, played, judge.quantity)


def longest(contract: dict[str, Any], seconds: float) -> float:
    """Return the duration of an episode: goals, and objects placed with them, do not change within one."""
    goals = [one for one in contract["commands"] if one["kind"] == "given" and not is_velocity(one)]
    step_dt = contract["rates"]["step_dt"]
    return min([seconds, *(one["resampling_s"][0] - step_dt for one in goals)])


def nominal_env(task: str, cfg: DeployConfig, pairs: int) -> Any:
    """Return the nominal environments, with the starts and the changes of commands of the task.

    Their episodes do not end.
    """
    checkpoint = find_checkpoint(task, cfg)
    evaluated = env_cfg_of(task, cfg, checkpoint, purpose="evaluate")
    agent = agent_cfg_of(task, checkpoint, cfg.profile)
    nominal, lacks = nominal_cfg(evaluated, agent.clip_actions)
    del nominal.events["deployment_start"]
    for name, seconds_range in lacks.resampling.items():
        command: Any = nominal.commands[name]
        command.resampling_time_range = seconds_range
        if hasattr(command, "sampling_mode"):
            command.sampling_mode = "uniform"
    # One rule judges both sides.
    nominal.terminations = {}
    # Motions are where they are, and so are the robots that track them.
    nominal.scene.env_spacing = 0.0
    nominal.scene.num_envs, nominal.seed = pairs, 1 if cfg.seed is None else cfg.seed
    return make_env(task, nominal, "cpu", agent=dataclasses.replace(agent))


if __name__ == "__main__":
    main()
