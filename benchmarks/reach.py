"""Position error of differential inverse kinematics: 1024 YAM arms, reaches of 10 cm."""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass

import mujoco
import torch
from measure import Row, show

from mjlab.asset_zoo.robots import get_yam_robot_cfg
from mjlab.entity import EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.envs.mdp import DifferentialIKAction, DifferentialIKActionCfg, joint_pos_rel
from mjlab.managers import ObservationGroupCfg, ObservationTermCfg
from mjlab.scene import SceneCfg
from mjlab.sim import MujocoCfg, SimulationCfg

NUM_ARMS = 1024
DISTANCE = 0.10
MOST_RESIDUAL = 0.002
ITERATIONS = 50
SECONDS = 3.0
DECIMATION = 4
TIMESTEP = 0.005


@dataclass(frozen=True)
class Case:
    """Target of the action."""

    what: str
    orientation_weight: float


CASES = (Case("position", 0.0), Case("position and orientation", 0.3))


def arm_cfg(carries_itself: bool) -> EntityCfg:
    """Return the YAM's config; an arm that carries itself has its weight compensated.

    The real arm's controller does that. Position drives as soft as the YAM's (2 Hz) otherwise sag,
    since the action's targets start from where the joints are.
    """
    cfg = copy.copy(get_yam_robot_cfg())
    make = cfg.spec_fn

    def compensated() -> mujoco.MjSpec:
        spec = make()
        for body in spec.bodies[1:]:
            body.gravcomp = 1.0
        return spec

    if carries_itself:
        cfg.spec_fn = compensated
    return cfg


def make_env(case: Case, carries_itself: bool) -> ManagerBasedRlEnv:
    """Return arms in their home pose, one at the same place in each environment."""
    action = DifferentialIKActionCfg(
        entity_name="robot",
        actuator_names=("joint[1-6]",),
        frame_type="site",
        frame_name="grasp_site",
        use_relative_mode=False,
        orientation_weight=case.orientation_weight,
    )
    joints = ObservationTermCfg(func=joint_pos_rel)
    cfg = ManagerBasedRlEnvCfg(
        decimation=DECIMATION,
        episode_length_s=1000.0,
        scene=SceneCfg(
            num_envs=NUM_ARMS, env_spacing=0.0, entities={"robot": arm_cfg(carries_itself)}
        ),
        sim=SimulationCfg(engine="native", mujoco=MujocoCfg(timestep=TIMESTEP)),
        observations={"actor": ObservationGroupCfg(terms={"joints": joints})},
        actions={"reach": action},
        rewards={},
        terminations={},
        seed=1,
    )
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    return env


class Reach:
    """One reach in a random direction for each arm, at the orientation that the hand has."""

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        term = env.action_manager.get_term("reach")
        assert isinstance(term, DifferentialIKAction)
        self.env, self.term = env, term
        self.arm = env.scene["robot"].data
        self.joints = term._columns
        position, quat = (part.clone() for part in term._get_frame_pose())
        generator = torch.Generator().manual_seed(0)
        direction = torch.randn(NUM_ARMS, 3, generator=generator)
        direction /= direction.norm(dim=1, keepdim=True)
        self.target = position + DISTANCE * direction
        self.action = torch.cat((self.target, quat), dim=1)[:, : term.action_dim]
        self.passed = -float("inf")

    def residuals(self) -> torch.Tensor:
        """Return each hand's distance from its target (m)."""
        return (self.term._get_frame_pose()[0] - self.target).norm(dim=1)

    def watch_limits(self) -> None:
        """Note how far any joint of any arm is past its limit (rad; negative: within)."""
        q = self.arm.joint_pos[:, self.joints]
        low, high = self.arm.joint_pos_limits[:, self.joints].unbind(-1)
        self.passed = max(self.passed, torch.maximum(low - q, q - high).max().item())

    def solve(self) -> tuple[int, float]:
        """Put the joints where the action wants them, again and again.

        Returns after how many iterations all hands were near enough (0: never), and the time of one
        iteration without the physics, in seconds.
        """
        near_after, spent = 0, 0.0
        self.term.process_actions(self.action)
        addresses = self.arm.indexing.joint_q_adr[self.joints].long()
        for iteration in range(1, ITERATIONS + 1):
            start = time.perf_counter()
            self.term.apply_actions()
            spent += time.perf_counter() - start
            self.env.sim.data.qpos[:, addresses] = self.arm.joint_pos_target[:, self.joints]
            self.env.sim.forward()
            self.watch_limits()
            if not near_after and self.residuals().max() < MOST_RESIDUAL:
                near_after = iteration
        return near_after, spent / ITERATIONS

    def simulate(self) -> float:
        """Let the arms move; return after how many seconds all hands were near enough, or 0."""
        near_after = 0.0
        for step in range(round(SECONDS / self.env.step_dt)):
            self.env.step(self.action)
            self.watch_limits()
            if not near_after and self.residuals().max() < MOST_RESIDUAL:
                near_after = (step + 1) * self.env.step_dt
        return near_after

    def row(self, what: str, how: str, has_to: bool = True) -> Row:
        """Return the row of a reach that is over."""
        worst, mean = self.residuals().max().item(), self.residuals().mean().item()
        reached = worst < MOST_RESIDUAL and self.passed < 0.0
        return Row(
            what=what,
            measured=f"at most {1000 * worst:.3g} mm, {1000 * mean:.3g} mm on average",
            compared_with=f"{how}; nearest a joint came to its limit: {-self.passed:.2g} rad",
            to_reach="under 2 mm, no joint limit passed" if has_to else "",
            reached=reached if has_to else None,
        )


def measure() -> list[Row]:
    """Measure the solver by itself, arms that carry themselves, and arms that sag."""
    rows = []
    for case in CASES:
        what = f"reach of 10 cm, {NUM_ARMS} arms, {case.what}"
        solved = Reach(make_env(case, carries_itself=True))
        iterations, seconds = solved.solve()
        how = (
            f"{iterations or 'never in ' + str(ITERATIONS)} iterations, {1e3 * seconds:.1f} ms each"
        )
        rows.append(solved.row(f"{what}: solver", how))
        for carries_itself in (True, False):
            moved = Reach(make_env(case, carries_itself))
            after = moved.simulate()
            weight = "weight compensated" if carries_itself else "drives alone against gravity"
            how = f"after {after:.2f} s of {SECONDS:g}" if after else f"not within {SECONDS:g} s"
            rows.append(moved.row(f"{what}: simulated, {weight}", how, has_to=carries_itself))
            moved.env.close()
        solved.env.close()
    return rows


if __name__ == "__main__":
    print(show(measure()))
