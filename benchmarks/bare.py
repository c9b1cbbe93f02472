"""Baselines on `mujoco.batch`: the bare substeps, and two tasks by hand for rsl_rl.

`python benchmarks/bare.py cartpole ITERATIONS SEED` trains the swing-up, with the PPO settings of the task.
`python benchmarks/bare.py go1 MINUTES SEED` trains and evaluates Go1 on flat ground, and prints one line of JSON
per evaluation. Model, control, observations, commands and pushes are those of
`Mjlab-Velocity-Flat-Unitree-Go1`, and contacts are simplified as in its `cpu` profile (here also in
evaluations). Rewards are hand-written, and PPO is rsl_rl's with the settings of the profile, without mirror images.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

if TYPE_CHECKING:
    from mjlab.rl.config import RslRlBaseRunnerCfg

CARTPOLE_ENVS, CARTPOLE_DT, CARTPOLE_DECIMATION, CARTPOLE_EPISODE = 512, 0.05, 5, 1000
GO1_DT, GO1_DECIMATION, GO1_EPISODE = 0.02, 4, 1000


class BareLoop:
    """The substeps of one environment step on `mujoco.batch`, and nothing else.

    State goes in and out as double-precision views, which cost nothing, and no derived quantity is
    copied out.
    """

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, num_threads: int, decimation: int
    ) -> None:
        self._batch = Batch(model, num_envs, num_threads)
        self._decimation = decimation
        names = ["qpos", "qvel", "ctrl"]
        if model.nmocap > 0:
            # Positions of the arms' bases.
            names += ["mocap_pos", "mocap_quat"]
        self.state = {name: self._batch.bind(name) for name in names}
        self.qpos, self.qvel, self.ctrl = (self.state[name] for name in names[:3])
        self._rays: list[dict[str, Any]] = []

    def expand(self, fields: Mapping[str, torch.Tensor]) -> None:
        """Give every simulation its own values (num_envs, ...) of these model fields."""
        for name, values in fields.items():
            own = self._batch.expand(name)
            own[:] = values.numpy().reshape(own.shape)

    def cast(self, rays: Iterable[tuple[np.ndarray, np.ndarray, tuple[int, ...]]]) -> None:
        """Cast these rays at the end of every step: origins and directions (num_envs, R, 3), groups."""
        self._rays = []
        for origins, directions, groups in rays:
            mask = np.zeros(6, dtype=np.uint8)
            mask[list(groups)] = 1
            self._rays.append(
                {
                    "pnt": np.ascontiguousarray(origins, dtype=np.float64),
                    "vec": np.ascontiguousarray(directions, dtype=np.float64),
                    "normal": True,
                    "geomgroup": mask,
                }
            )

    def __call__(self) -> None:
        self._batch.step(nstep=self._decimation)
        for rays in self._rays:
            self._batch.ray(**rays)


class BareCartpole(VecEnv):
    """The swing-up by hand: no managers, no entities, no configs."""

    def __init__(self) -> None:
        import mjlab.tasks.cartpole

        folder = Path(mjlab.tasks.cartpole.__file__).parent
        model = mujoco.MjModel.from_xml_path(str(folder / "cartpole.xml"))
        model.opt.timestep = CARTPOLE_DT / CARTPOLE_DECIMATION
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        self.num_envs, self.num_actions, self.device, self.cfg = CARTPOLE_ENVS, 1, "cpu", {}
        self.max_episode_length = CARTPOLE_EPISODE
        self.episode_length_buf = torch.zeros(CARTPOLE_ENVS, dtype=torch.long)
        self._batch = Batch(model, CARTPOLE_ENVS)
        # Views of the rows, in double precision.
        fields = (self._batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
        self._qpos, self._qvel, self._ctrl = (torch.from_numpy(field) for field in fields)
        self._reset(torch.arange(CARTPOLE_ENVS))

    def _reset(self, ids: torch.Tensor) -> None:
        self._qpos[ids] = torch.tensor([0.0, math.pi], dtype=torch.float64)
        self._qpos[ids, 1] += torch.empty(len(ids)).uniform_(-0.034, 0.034)
        self._qvel[ids] = torch.empty(len(ids), 2, dtype=torch.float64).uniform_(-0.01, 0.01)
        self.episode_length_buf[ids] = 0

    def get_observations(self) -> TensorDict:
        angle = self._qpos[:, 1:2]
        parts = (self._qpos[:, :1], torch.cos(angle), torch.sin(angle), self._qvel)
        observation = torch.cat(parts, dim=-1).float()
        return TensorDict({"actor": observation, "critic": observation}, batch_size=[self.num_envs])

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        self._ctrl[:] = actions
        self._batch.step(nstep=CARTPOLE_DECIMATION)
        self.episode_length_buf += 1
        log10 = math.log(0.1)
        reward = (
            (torch.cos(self._qpos[:, 1]) + 1) / 2
            * (1 + torch.exp(log10 * (self._qpos[:, 0] / 2) ** 2)) / 2
            * (4 + (1 - actions[:, 0] ** 2).clamp(min=0)) / 5
            * (1 + torch.exp(log10 * (self._qvel[:, 1] / 5) ** 2)) / 2
        )  # fmt: skip
        time_outs = self.episode_length_buf >= self.max_episode_length
        ids = time_outs.nonzero().flatten()
        if len(ids):
            self._reset(ids)
        extras = {"time_outs": time_outs}
        return self.get_observations(), reward.float() * CARTPOLE_DT, time_outs.long(), extras


def go1_model() -> mujoco.MjModel:
    """Return the task's model: one Go1 on a plane, with the contacts of the `cpu` profile."""
    from mjlab.asset_zoo.robots.unitree_go1.go1_constants import get_go1_robot_cfg
    from mjlab.scene import Scene, SceneCfg
    from mjlab.terrains import TerrainEntityCfg

    scene = Scene(
        SceneCfg(terrain=TerrainEntityCfg(), entities={"robot": get_go1_robot_cfg()}, num_envs=1),
        device="cpu",
    )
    model = scene.compile()
    model.opt.timestep = GO1_DT / GO1_DECIMATION
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
        from mjlab.asset_zoo.robots.unitree_go1.go1_constants import GO1_ACTION_SCALE

        model = go1_model()
        self.num_envs, self.num_actions, self.device, self.cfg = num_envs, 12, "cpu", {}
        self.max_episode_length = GO1_EPISODE
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
        self._batch.step(nstep=GO1_DECIMATION)
        self.episode_length_buf += 1
        self._time_left -= GO1_DT
        self._next_push -= GO1_DT
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
        return self.get_observations(), reward * GO1_DT, dones.long(), extras

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
    for _ in range(GO1_EPISODE):
        totals += torch.stack(env.errors()) * running
        counts += running
        observations, _, dones, _ = env.step(policy(observations))
        fallen |= running & env.falls
        running &= dones == 0
    linear, angular = (totals / counts).mean(1).tolist()
    return {"linear": linear, "angular": angular, "falls": fallen.float().mean().item()}


def rsl_rl_cfg(cfg: RslRlBaseRunnerCfg) -> dict[str, Any]:
    """Return `cfg` with the fields that rsl_rl's own runner accepts."""
    fields = asdict(cfg)
    for model in ("actor", "critic"):
        for unused in ("cnn_cfg", "rnn_type", "rnn_hidden_dim", "rnn_num_layers"):
            fields[model].pop(unused)
    fields["critic"].pop("distribution_cfg")
    return fields


def train_cartpole(iterations: int) -> None:
    """Train the swing-up."""
    from mjlab.tasks.cartpole.cartpole_env_cfg import cartpole_ppo_runner_cfg

    with tempfile.TemporaryDirectory() as folder:
        cfg = rsl_rl_cfg(cartpole_ppo_runner_cfg())
        OnPolicyRunner(BareCartpole(), cfg, folder, "cpu").learn(
            iterations, init_at_random_ep_len=True
        )


def train_go1(minutes: float) -> None:
    """Train Go1 until an evaluation tracks the command or the time is over."""
    from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

    begin = time.perf_counter()
    task = "Mjlab-Velocity-Flat-Unitree-Go1"
    cfg = rsl_rl_cfg(load_rl_cfg(task, profile="cpu"))
    # Mirror images require the task's observation terms.
    cfg["algorithm"]["symmetry_cfg"] = None
    num_envs = load_env_cfg(task, profile="cpu").scene.num_envs
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


def main() -> None:
    task, budget, seed = sys.argv[1:]
    torch.set_num_threads(1)
    torch.manual_seed(int(seed))
    if task == "cartpole":
        train_cartpole(int(budget))
    else:
        train_go1(float(budget))


if __name__ == "__main__":
    main()
