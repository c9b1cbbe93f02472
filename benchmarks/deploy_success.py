"""Success of a deployed policy in plain MuJoCo against its environment: same starts, same commands.

The environment, without noise, pushes, delays and randomization, records starts and commands. The bundle's
`runtime.py` and `simulate.py` then play the same episodes with `mj_step`. An episode succeeds if the robot
neither tilts by more than `limits.tilt` nor sinks below half of its initial height.
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

from mjlab.cli.policy_flags import env_cfg_of, find_checkpoint, parse_policy_flags
from mjlab.deploy.evidence import Programs, rotations
from mjlab.deploy.golden import STATE
from mjlab.deploy.nominal import nominal_cfg
from mjlab.deploy.stress import has_fallen
from mjlab.deploy.usual_terms import is_velocity
from mjlab.managers import TerminationTermCfg
from mjlab.rl.exporter_utils import OnnxPolicy
from mjlab.runs.policy import agent_cfg_of, make_env
from mjlab.scripts.deploy import DeployConfig, policy_of, run_deploy

NORMAL = 1.96
"""Half-width of a 95 % interval, in standard errors."""


@dataclass(frozen=True)
class Episodes:
    """Episodes of the environment."""

    states: list[dict[str, np.ndarray]]
    """State at the start of each episode, by field."""
    commands: dict[str, np.ndarray]
    """Given commands by name, (T, N, size)."""
    outcomes: list[Outcome]
    """Outcome of each episode."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of an episode."""

    succeeds: bool
    error: float
    """Mean difference of the horizontal velocity from the command (m/s); NaN after a fall."""


class Judge:
    """Judge of episodes by the motion of the root."""

    def __init__(self, contract: dict[str, Any], model: mujoco.MjModel) -> None:
        """Find the root."""
        joint = int(model.body(contract["robot"]["root_body"]).jntadr[0])
        self.qpos, self.qvel = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        self.contract = contract

    def root(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Return height, quaternion and linear velocity (world axes) of the root, (..., 8)."""
        place, speed = qpos[..., self.qpos : self.qpos + 7], qvel[..., self.qvel : self.qvel + 3]
        return np.concatenate((place[..., 2:], speed), axis=-1)

    def outcome(self, roots: np.ndarray, command: np.ndarray) -> Outcome:
        """Return the outcome of an episode with these roots (T, 8) and velocity commands (T, 3)."""
        matrices = rotations(roots[:, 1:5])
        if has_fallen(self.contract, roots[:, 0], matrices[:, 2, 2]).any():
            return Outcome(False, math.nan)
        measured = np.einsum("tji,tj->ti", matrices, roots[:, 5:])[:, :2]
        return Outcome(True, float(np.linalg.norm(measured - command[:, :2], axis=1).mean()))


def given_names(contract: dict[str, Any]) -> list[str]:
    """Return the names of the given commands, that of the velocity first."""
    given = [one for one in contract["commands"] if one["kind"] == "given"]
    return [one["name"] for one in sorted(given, key=is_velocity, reverse=True)]


def in_environment(env: Any, contract: dict[str, Any], policy: OnnxPolicy, steps: int) -> Episodes:
    """Play one episode in each environment."""
    names = given_names(contract)
    judge, host = Judge(contract, env.sim.mj_model), mujoco.MjData(env.sim.mj_model)
    commands: dict[str, list[np.ndarray]] = {name: [] for name in names}
    roots, states = [], []
    clip = contract["policy"]["clip"]
    with env.curricula_held(), torch.no_grad():
        observations, _ = env.reset()
        policy.reset()
        for k in range(env.num_envs):
            env.sim.copy_to_host(k, host)
            states.append({field: np.array(getattr(host, field)) for field in STATE})
        for _ in range(steps):
            for name in names:
                commands[name].append(env.command_manager.get_command(name).cpu().numpy().copy())
            action = policy(observations)
            observations, *_ = env.step(action if clip is None else action.clamp(-clip, clip))
            qpos, qvel = (x.cpu().double().numpy() for x in (env.sim.data.qpos, env.sim.data.qvel))
            roots.append(judge.root(qpos, qvel))
    stacked = {name: np.array(rows) for name, rows in commands.items()}
    first, moved = stacked[names[0]], np.array(roots)
    outcomes = [judge.outcome(moved[:, k], first[:, k]) for k in range(env.num_envs)]
    return Episodes(states, stacked, outcomes)


def in_mujoco(bundle: Path, episodes: Episodes) -> list[Outcome]:
    """Play the same episodes by the programs of the bundle."""
    programs = Programs.load(bundle)
    policy = programs.runtime.Policy.load(bundle)
    simulation = programs.simulate.Simulation(policy.contract, programs.simulate.load_model(bundle))
    judge, outcomes = Judge(policy.contract, simulation.model), []
    first = next(iter(episodes.commands.values()))
    for k, state in enumerate(episodes.states):
        simulation.reset()
        simulation.set_state(**state)
        policy.reset()
        roots = []
        for t in range(len(first)):
            command = {name: values[t, k] for name, values in episodes.commands.items()}
            simulation.apply(policy.step(simulation.measure(), command))
            roots.append(judge.root(simulation.data.qpos, simulation.data.qvel))
        outcomes.append(judge.outcome(np.array(roots), first[:, k]))
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


def show(episodes: Episodes, played: list[Outcome]) -> None:
    """Print success rates, mean errors, and their paired differences."""
    pairs = list(zip(episodes.outcomes, played, strict=True))
    success = [a.succeeds for a, _ in pairs], [b.succeeds for _, b in pairs]
    rates = [100.0 * float(np.mean(one)) for one in success]
    print(f"success in the environment {rates[0]:.1f} %, in plain MuJoCo {rates[1]:.1f} %")
    by, low, high = (100.0 * x for x in difference_of_success(*success))
    print(f"paired difference {by:+.1f} points, 95 % interval {low:+.1f} to {high:+.1f}")
    errors = np.array([(a.error, b.error) for a, b in pairs if a.succeeds and b.succeeds])
    if len(errors) > 1:
        change = errors[:, 1] - errors[:, 0]
        half = NORMAL * change.std(ddof=1) / math.sqrt(len(change))
        print(
            f"velocity error {errors[:, 0].mean():.4f} and {errors[:, 1].mean():.4f} m/s; paired "
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
    task, path, flags = policy_of(options.policy, [])
    with tempfile.TemporaryDirectory() as temporary:
        bundle = Path(options.bundle or f"{temporary}/bundle")
        flags = ["--checkpoint-file", str(path), "--output", str(bundle), "--steps", "100", *flags]
        cfg = parse_policy_flags(DeployConfig, flags, task, "deploy", purpose="evaluate")
        if options.bundle is None:
            run_deploy(task, cfg)
        contract = json.loads((bundle / "contract.json").read_text(encoding="utf-8"))
        if not any(map(is_velocity, contract["commands"])):
            raise SystemExit("Expected a policy with a velocity command.")
        start = time.perf_counter()
        env = nominal_env(task, cfg, options.pairs, options.seconds)
        steps = round(options.seconds / contract["rates"]["step_dt"])
        policy = OnnxPolicy(bundle / contract["policy"]["file"], num_envs=options.pairs)
        episodes = in_environment(env.unwrapped, contract, policy, steps)
        env.close()
        played_from = time.perf_counter()
        played = in_mujoco(bundle, episodes)
    ended = time.perf_counter()
    print(f"{task}: {options.pairs} pairs of {options.seconds:g} s, ", end="")
    print(f"{played_from - start:.0f} s and {ended - played_from:.0f} s")
    show(episodes, played)


def nominal_env(task: str, cfg: DeployConfig, pairs: int, seconds: float) -> Any:
    """Return the nominal environments, with the starts and the changes of commands of the task."""
    checkpoint = find_checkpoint(task, cfg)
    evaluated = env_cfg_of(task, cfg, checkpoint, purpose="evaluate")
    agent = agent_cfg_of(task, checkpoint, cfg.profile)
    nominal, lacks = nominal_cfg(evaluated, agent.clip_actions)
    del nominal.events["deployment_start"]
    for name, seconds_range in lacks.resampling.items():
        nominal.commands[name].resampling_time_range = seconds_range
    # Falls are judged by the same rule on both sides.
    over = {name: term for name, term in nominal.terminations.items() if _is_time_out(term)}
    nominal.terminations, nominal.episode_length_s = over, seconds + 1.0
    nominal.scene.num_envs, nominal.seed = pairs, 1 if cfg.seed is None else cfg.seed
    return make_env(task, nominal, "cpu", agent=dataclasses.replace(agent))


def _is_time_out(term: TerminationTermCfg | None) -> bool:
    return term is not None and term.time_out


if __name__ == "__main__":
    main()
