"""Baseline: Go1 on flat ground with `mujoco.batch` and rsl_rl only.

Model, control, observations, commands and pushes are those of `Mjlab-Velocity-Flat-Unitree-Go1`, and
contacts are simplified as in its `cpu` profile (here also in evaluations); rewards
are hand-written, and PPO is rsl_rl's with the settings of the profile, without mirror
images. `python benchmarks/bare_go1.py MINUTES SEED` trains and evaluates, and
prints one line of JSON per evaluation.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from mjlab.asset_zoo.robots.unitree_go1.go1_constants import GO1_ACTION_SCALE, get_go1_robot_cfg
from mjlab.scene import Scene, SceneCfg
from mjlab.terrains import TerrainEntityCfg

DECIMATION, DT = 4, 0.02
EPISODE_STEPS = 1000
GROUND = ("trunk_collision", "head_collision")


def go1_model() -> mujoco.MjModel:
    """Return the task's model: one Go1 on a plane, with the contacts of the `cpu` profile."""
    scene = Scene(
        SceneCfg(terrain=TerrainEntityCfg(), entities={"robot": get_go1_robot_cfg()}, num_envs=1),
        device="cpu",
    )
    model = scene.compile()
    model.opt.timestep = DT / DECIMATION
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    model.geom_condim[:] = np.minimum(model.geom_condim, 3)
    model.opt.impratio, model.opt.iterations, model.opt.ls_iterations = 10, 10, 20
    return model


def rotate_back(quat: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Return world `vector` (N, 3) in the frame of `quat` (N, 4), w first."""
    w, axis = quat[:, :1], -quat[:, 1:]
    twice = 2 * torch.linalg.cross(axis, vector)
    return vector + w * twice + torch.linalg.cross(axis, twice)


class BareGo1(VecEnv):
    """The velocity task by hand: no managers, no entities, no sensors."""

    def __init__(self, num_envs: int) -> None:
        model = go1_model()
        self.num_envs, self.num_actions, self.device, self.cfg = num_envs, 12, "cpu", {}
        self.max_episode_length = EPISODE_STEPS
        self.episode_length_buf = torch.zeros(num_envs, dtype=torch.long)
        self._batch = Batch(model, num_envs)
        # Views of the rows, in double precision.
        fields = (self._batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
        self._qpos, self._qvel, self._ctrl = (torch.from_numpy(field) for field in fields)
        self._home = torch.from_numpy(model.key_qpos[0])
        names = [model.joint(i).name for i in range(1, 13)]
        scales = [next(s for k, s in GO1_ACTION_SCALE.items() if n.endswith(k[2:])) for n in names]
        self._scale = torch.tensor(scales)
        # Joint of each control: actuators come config by config, hips and thighs before calves.
        self._driven = torch.from_numpy(model.actuator_trnid[:, 0] - 1).long()
        limits = torch.from_numpy(model.jnt_range[1:].astype(np.float32))
        middle, half = limits.mean(1), 0.45 * (limits[:, 1] - limits[:, 0])
        self._low, self._high = middle - half, middle + half
        self._command = torch.zeros(num_envs, 3)
        self._time_left = torch.zeros(num_envs)
        self._next_push = torch.rand(num_envs) * 2 + 1
        self._action = torch.zeros(num_envs, 12)
        self.falls = torch.zeros(num_envs, dtype=torch.bool)
        self._reset(torch.arange(num_envs))

    def _reset(self, ids: torch.Tensor) -> None:
        self._qpos[ids] = self._home
        self._qpos[ids, 2] += torch.rand(len(ids)) * 0.04 + 0.01
        yaw = torch.rand(len(ids), dtype=torch.float64) * 6.28
        self._qpos[ids, 3], self._qpos[ids, 6] = torch.cos(yaw / 2), torch.sin(yaw / 2)
        self._qvel[ids] = 0.0
        self._action[ids] = 0.0
        self.episode_length_buf[ids] = 0
        self._resample(ids)

    def _resample(self, ids: torch.Tensor) -> None:
        low, high = torch.tensor([-1.0, -1.0, -0.5]), torch.tensor([1.0, 1.0, 0.5])
        self._command[ids] = low + (high - low) * torch.rand(len(ids), 3)
        self._command[ids] *= (torch.rand(len(ids), 1) > 0.1).float()
        self._time_left[ids] = torch.rand(len(ids)) * 5 + 3

    def velocities(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return linear and angular velocity of the trunk in its own frame, each (N, 3)."""
        qpos, qvel = self._qpos.float(), self._qvel.float()
        return rotate_back(qpos[:, 3:7], qvel[:, :3]), qvel[:, 3:6]

    def errors(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the errors of linear (N,) and angular velocity (N,)."""
        linear, angular = self.velocities()
        return (
            (self._command[:, :2] - linear[:, :2]).norm(dim=1),
            (self._command[:, 2] - angular[:, 2]).abs(),
        )

    def get_observations(self) -> TensorDict:
        linear, angular = self.velocities()
        noise = torch.rand(self.num_envs, 33) * 2 - 1
        parts = (
            linear + 0.5 * noise[:, :3], angular + 0.2 * noise[:, 3:6],
            self._gravity() + 0.05 * noise[:, 6:9],
            self._qpos[:, 7:] - self._home[7:] + 0.01 * noise[:, 9:21],
            self._qvel[:, 6:] + 1.5 * noise[:, 21:33], self._action, self._command,
        )  # fmt: skip
        observation = torch.cat(parts, dim=-1).float()
        return TensorDict({"actor": observation, "critic": observation}, batch_size=[self.num_envs])

    def _gravity(self) -> torch.Tensor:
        down = torch.tensor([0.0, 0.0, -1.0]).expand(self.num_envs, 3)
        return rotate_back(self._qpos[:, 3:7].float(), down)

    def _reward(self, action: torch.Tensor) -> torch.Tensor:
        linear, angular = self.velocities()
        joints = self._qpos[:, 7:].float()
        off = (self._command[:, :2] - linear[:, :2]).square().sum(1) + linear[:, 2].square()
        turn = (self._command[:, 2] - angular[:, 2]).square() + angular[:, :2].square().sum(1)
        beyond = (joints - self._high).clamp(min=0) + (self._low - joints).clamp(min=0)
        moving = (self._command.abs().sum(1) > 0.05).float()
        pose = (joints - self._home[7:]).square().mean(1) / (0.05 + 0.15 * moving) ** 2
        return (
            2 * torch.exp(-off / 0.25) + 2 * torch.exp(-turn / 0.5)
            + torch.exp(-self._gravity()[:, :2].square().sum(1) / 0.2) + torch.exp(-pose)
            - 0.01 * (action - self._action).square().sum(1) - beyond.sum(1)
        )  # fmt: skip

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        self._ctrl[:] = (self._home[7:] + self._scale * actions)[:, self._driven]
        self._batch.step(nstep=DECIMATION)
        self.episode_length_buf += 1
        self._time_left -= DT
        self._next_push -= DT
        reward = self._reward(actions).float()
        self._action = actions.clone()
        self.falls = self._gravity()[:, 2] > -0.34
        time_outs = self.episode_length_buf >= self.max_episode_length
        dones = self.falls | time_outs
        self._push()
        for due, act in ((self._time_left <= 0, self._resample), (dones, self._reset)):
            ids = due.nonzero().flatten()
            if len(ids):
                act(ids)
        extras = {"time_outs": time_outs & ~self.falls}
        return self.get_observations(), reward * DT, dones.long(), extras

    def _push(self) -> None:
        ids = (self._next_push <= 0).nonzero().flatten()
        size = torch.tensor([0.5, 0.5, 0.4, 0.52, 0.52, 0.78])
        self._qvel[ids, :6] += size * (torch.rand(len(ids), 6) * 2 - 1)
        self._next_push[ids] = torch.rand(len(ids)) * 2 + 1


def evaluate(env: BareGo1, policy: Any) -> dict[str, float]:
    """Return errors and the rate of falls over the first episode of each environment."""
    env._reset(torch.arange(env.num_envs))
    running = torch.ones(env.num_envs, dtype=torch.bool)
    fallen = torch.zeros(env.num_envs, dtype=torch.bool)
    totals, counts = torch.zeros(2, env.num_envs), torch.zeros(env.num_envs)
    observations = env.get_observations()
    for _ in range(EPISODE_STEPS):
        totals += torch.stack(env.errors()) * running
        counts += running
        observations, _, dones, _ = env.step(policy(observations))
        fallen |= running & env.falls
        running &= dones == 0
    linear, angular = (totals / counts).mean(1).tolist()
    return {"linear": linear, "angular": angular, "falls": fallen.float().mean().item()}


def profile_cfg() -> tuple[dict[str, Any], int]:
    """Return rsl_rl's learner config and the number of environments."""
    from dataclasses import asdict

    from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

    task = "Mjlab-Velocity-Flat-Unitree-Go1"
    cfg = asdict(load_rl_cfg(task, profile="cpu"))
    for model in ("actor", "critic"):
        for unused in ("cnn_cfg", "rnn_type", "rnn_hidden_dim", "rnn_num_layers"):
            cfg[model].pop(unused)
    cfg["critic"].pop("distribution_cfg")
    # Mirror images require the task's observation terms.
    cfg["algorithm"]["symmetry_cfg"] = None
    return cfg, load_env_cfg(task, profile="cpu").scene.num_envs


def main() -> None:
    minutes, seed = float(sys.argv[1]), int(sys.argv[2])
    begin = time.perf_counter()
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    cfg, num_envs = profile_cfg()
    runner = OnPolicyRunner(BareGo1(num_envs), cfg, None, "cpu")
    beside = BareGo1(200)
    iterations, every = 0, 100
    while time.perf_counter() - begin < 60 * minutes:
        runner.learn(every, init_at_random_ep_len=iterations == 0)
        iterations += every
        with torch.inference_mode():
            metrics = evaluate(beside, runner.get_inference_policy())
        seconds = time.perf_counter() - begin
        samples = iterations * num_envs * cfg["num_steps_per_env"]
        print(
            json.dumps(
                {"seconds": seconds, "iterations": iterations, "samples": samples} | metrics
            ),
            flush=True,
        )
        if metrics["linear"] < 0.25 and metrics["angular"] < 0.35 and metrics["falls"] < 0.05:
            break


if __name__ == "__main__":
    main()
