"""Speed of whole tasks: `env.step` over a bare `mujoco.batch` loop of the same model.

Those are the velocity tasks, lifting a cube from the state, and motion tracking.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

import torch
from bare import BareLoop
from measure import Row, alternate, show

from mjlab.envs import ManagerBasedRlEnv
from mjlab.sim.engine import RayQuery
from mjlab.tasks.registry import load_env_cfg

NUM_THREADS = 2
ACTION_SIZE = 0.3
STEPS_BEFORE = 25


@dataclass(frozen=True)
class Case:
    """A task and the ratio to reach on it."""

    task: str
    what: str
    to_reach: float
    with_rays: bool = False
    num_envs: int = 1024


CASES = (
    Case("Mjlab-Velocity-Flat-Unitree-Go1", "Go1 flat", 0.80),
    Case("Mjlab-Velocity-Flat-Unitree-G1", "G1 flat", 0.83),
    Case("Mjlab-Velocity-Rough-Unitree-Go1", "Go1 rough with its height scan", 0.75, True),
    Case("Mjlab-Lift-Cube-Yam", "Lift cube from state", 0.84),
    Case("Mjlab-Tracking-Flat-Unitree-G1", "G1 tracking", 0.78, num_envs=512),
)


def make_env(task: str, num_envs: int) -> ManagerBasedRlEnv:
    """Return the task's environments, just reset."""
    cfg = load_env_cfg(task)
    cfg.scene.num_envs = num_envs
    cfg.sim.num_threads = NUM_THREADS
    cfg.sim.engine = "native"
    cfg.seed = 1
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    return env


def recorded_rays(env: ManagerBasedRlEnv) -> list[RayQuery]:
    """Return all ray casts of one step."""
    queries: list[RayQuery] = []
    engine: Any = env.sim._engine
    original = engine.raycast
    engine.raycast = lambda query: queries.append(query) or original(query)
    env.sim.sense()
    engine.raycast = original
    return queries


def measure_case(case: Case) -> Row:
    """Measure one task.

    The bare loop steps the environments' models, including randomized fields, and starts each step
    from the states of the environments, with the same controls: the cost of physics depends on the
    motion of the robot.
    """
    env = make_env(case.task, case.num_envs)
    generator = torch.Generator().manual_seed(0)
    shape = (case.num_envs, env.action_manager.total_action_dim)
    actions = ACTION_SIZE * torch.randn(shape, generator=generator)
    step = torch.inference_mode()(env.step)
    for _ in range(STEPS_BEFORE):
        step(actions)
    bare = BareLoop(env.sim.mj_model, case.num_envs, NUM_THREADS, env.cfg.decimation)
    bare.expand({name: getattr(env.sim.model, name) for name in env.sim.expanded_fields})

    def same_states() -> None:
        for name, values in bare.state.items():
            values[:] = getattr(env.sim.data, name).numpy()
        if case.with_rays:
            bare.cast(
                (rays.origins.numpy(), rays.directions.numpy(), tuple(rays.geom_groups or range(6)))
                for rays in recorded_rays(env)
            )

    same_states()
    env_time, bare_time = alternate(
        bare, lambda: step(actions), steps=1, repeats=51, before=same_states
    )[::-1]
    ratio = bare_time / env_time
    rays = ", same rays" if case.with_rays else ""
    return Row(
        f"{case.what}, {case.num_envs} envs, native, {NUM_THREADS} threads: `env.step` over the bare "
        f"loop{rays}",
        f"{ratio:.2f} ({case.num_envs / env_time:,.0f} env-steps/s)",
        f"bare `mujoco.batch` loop: {case.num_envs / bare_time:,.0f} env-steps/s",
        f"at least {case.to_reach:.2f}",
        ratio >= case.to_reach,
    )


def measure(keyword: str = "") -> list[Row]:
    """Measure every task whose name contains `keyword`.

    Steps are as those of training: in inference mode, with one thread of torch.
    """
    torch.set_num_threads(1)
    return [measure_case(case) for case in CASES if keyword in case.task]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("keyword", nargs="?", default="", help="part of a task's name")
    print(show(measure(parser.parse_args().keyword)))
