"""Baseline: cartpole swing-up with `mujoco.batch` and rsl_rl only.

Model, reward, observations, episode length and PPO settings are those of the task; everything is
written out by hand for this one task. `python benchmarks/bare_loop.py ITERATIONS SEED` prints the
iterations and when the last one was finished.
"""

from __future__ import annotations

import math
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

import mujoco
import torch
from mujoco.batch import Batch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

import mjlab.tasks.cartpole
from mjlab.tasks.cartpole.cartpole_env_cfg import cartpole_ppo_runner_cfg

NUM_ENVS = 512
DECIMATION = 5
MAX_EPISODE_LENGTH = 1000
DT = 0.05


class BareCartpole(VecEnv):
    """The swing-up by hand: no managers, no entities, no configs."""

    def __init__(self) -> None:
        folder = Path(mjlab.tasks.cartpole.__file__).parent
        model = mujoco.MjModel.from_xml_path(str(folder / "cartpole.xml"))
        model.opt.timestep = DT / DECIMATION
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        self.num_envs, self.num_actions, self.device, self.cfg = NUM_ENVS, 1, "cpu", {}
        self.max_episode_length = MAX_EPISODE_LENGTH
        self.episode_length_buf = torch.zeros(NUM_ENVS, dtype=torch.long)
        self._batch = Batch(model, NUM_ENVS)
        # Views of the rows, in double precision.
        fields = (self._batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
        self._qpos, self._qvel, self._ctrl = (torch.from_numpy(field) for field in fields)
        self._reset(torch.arange(NUM_ENVS))

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
        self._batch.step(nstep=DECIMATION)
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
        return self.get_observations(), reward.float() * DT, time_outs.long(), extras


def main() -> None:
    iterations, seed = int(sys.argv[1]), int(sys.argv[2])
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    cfg = asdict(cartpole_ppo_runner_cfg())
    for model in ("actor", "critic"):
        for unused in ("cnn_cfg", "rnn_type", "rnn_hidden_dim", "rnn_num_layers"):
            cfg[model].pop(unused)
    cfg["critic"].pop("distribution_cfg")
    with tempfile.TemporaryDirectory() as folder:
        runner = OnPolicyRunner(BareCartpole(), cfg, folder, "cpu")
        runner.learn(iterations, init_at_random_ep_len=True)


if __name__ == "__main__":
    main()
