"""Environments as TorchRL sees them, by its own adapter `MJLabEnv` and by `GymWrapper`."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("torchrl")

from rl_ending_env import TASK, ends
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper, MJLabEnv
from torchrl.envs.utils import check_env_specs

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import gymnasium_env
from mjlab.tasks.registry import load_env_cfg

N, STEPS = 3, 9
# Environment 1 runs out of time in every third step; environments 0 and 2 fail.
ENDS = {"failed": [2, 99, 4], "time_out": [99, 3, 99]}


def make_cfg():
    cfg = load_env_cfg(TASK)
    cfg.seed, cfg.sim.engine, cfg.scene.num_envs = 5, "native", N
    ends(cfg, **ENDS)
    return cfg


@pytest.fixture(params=[False, True], ids=["torchrl_resets", "mjlab_resets"])
def env(request):
    env = MJLabEnv(TASK, cfg=make_cfg(), num_envs=N, device="cpu", native_autoreset=request.param)
    yield env
    env.close()


def constant(group: str = "actor") -> TensorDictModule:
    """Return a policy that pushes with half of the force."""
    return TensorDictModule(lambda rows: torch.full((N, 1), 0.5), [group], ["action"])


@pytest.mark.parametrize("num_envs", [1, 4])
@pytest.mark.parametrize("task", [TASK, "Mjlab-Velocity-Flat-Unitree-Go1"])
def test_specs_hold(task, num_envs):
    env = MJLabEnv(task, num_envs=num_envs, device="cpu")
    check_env_specs(env)
    assert env.batch_size == (num_envs,)
    env.close()


def test_a_rollout_has_the_values_of_each_step(env):
    data = env.rollout(STEPS, constant(), break_when_any_done=False)
    plain = ManagerBasedRlEnv(make_cfg(), device="cpu")
    plain.reset()
    rewards, terminated, truncated = [], [], []
    for _ in range(STEPS):
        _, *values, _ = plain.step(torch.full((N, 1), 0.5))
        for kept, value in zip((rewards, terminated, truncated), values, strict=True):
            kept.append(value)
    plain.close()
    found = data["next"]
    assert torch.equal(found["terminated"][..., 0], torch.stack(terminated, dim=1))
    assert torch.equal(found["truncated"][..., 0], torch.stack(truncated, dim=1))
    assert found["truncated"].sum(dim=1).flatten().tolist() == [0, 3, 0]
    assert found["terminated"].sum(dim=1).flatten().tolist() == [4, 0, 2]
    torch.testing.assert_close(found["reward"][..., 0], torch.stack(rewards, dim=1))
    assert len(found["reward"].unique()) > STEPS


def test_a_collector_has_the_values_of_each_step(env):
    collector = Collector(env, constant(), frames_per_batch=N * STEPS, total_frames=N * STEPS)
    (data,) = list(collector)
    rewards = data["next", "reward"]
    assert len(rewards.unique()) > STEPS
    assert data["next", "truncated"].sum() == 3
    collector.shutdown()


def test_the_same_seed_repeats_the_rollout(env):
    runs = []
    for _ in range(2):
        env.set_seed(3)
        runs.append(env.rollout(STEPS, constant(), break_when_any_done=False))
    assert torch.equal(runs[0]["next", "reward"], runs[1]["next", "reward"])


def test_gym_wrapper_assigns_final_observations():
    core = ManagerBasedRlEnv(make_cfg(), device="cpu")
    env = GymWrapper(gymnasium_env(core, group="actor"))
    data = env.rollout(STEPS, constant("observation"), break_when_any_done=False)
    ended = data["next", "done"][..., 0]
    final, following = data["next", "observation"][:, :-1], data["observation"][:, 1:]
    same = torch.isclose(final, following.to(final)).all(dim=-1)
    assert torch.equal(same, ~ended[:, :-1])
    assert data["next", "truncated"].sum() == 3
    env.close()
