"""Every task runs on a CUDA device: no tensor is left behind on the host, or fetched from there.

There is no GPU in these tests; `pretend_cuda` keeps the rules of one.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.envs.env_checks import as_action
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.tasks.registry import list_tasks, load_env_cfg, load_rl_cfg, load_runner_cls

from .pretend_cuda import DEVICE, PretendCuda, install, is_marked

NUM_ENVS = 4
# What a step looks up on the device: which environments end, and which are due for the other three.
LOOKED_UP = {
    "envs/manager_based_rl_env.py _reset_done_envs: nonzero",
    "managers/event_manager.py _apply_interval: nonzero",
    "managers/command_manager.py compute: nonzero",
    "tasks/tracking/mdp/motion_command.py _update_command: nonzero",
}
# Besides that, a step with resets draws from ranges of the config that it copies to the device, and
# logs levels of terrain. `keep_apart` draws until objects are apart, which it has to look up.
MOST_WAITS_OF_RESETS = 3
# With mirror images, and with what the runner of tracking does besides.
LEARNED = ("Mjlab-Velocity-Flat-Unitree-Go1", "Mjlab-Tracking-Flat-Unitree-G1")
EPISODE_STEPS = 6


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> Iterator[PretendCuda]:
    mode = PretendCuda()
    install(monkeypatch, mode)
    with mode:
        yield mode


def make_env(task: str, episode_steps: int | None = None) -> ManagerBasedRlEnv:
    cfg = load_env_cfg(task)
    cfg.scene.num_envs, cfg.seed = NUM_ENVS, 1
    if episode_steps is not None:
        cfg.episode_length_s = episode_steps * cfg.decimation * cfg.sim.mujoco.timestep
    if cfg.scene.terrain and cfg.scene.terrain.terrain_generator:
        cfg.scene.terrain.terrain_generator.num_rows = 2
        cfg.scene.terrain.terrain_generator.num_cols = 2
    return ManagerBasedRlEnv(cfg, device=DEVICE)


# The pretended device.


@pytest.mark.parametrize(
    "mixture",
    [
        lambda gpu, cpu: gpu + cpu,
        lambda gpu, cpu: torch.cat((gpu, cpu)),
        lambda gpu, cpu: torch.where(gpu > 0, gpu, cpu),
        lambda gpu, cpu: cpu.index_copy_(0, torch.zeros(1, dtype=torch.long), gpu[:1]),
        lambda gpu, cpu: cpu[gpu.long()],
        lambda gpu, cpu: gpu.view(-1).clone().mul_(cpu),
        lambda gpu, cpu: torch.stack((gpu[0], torch.tensor(1.0))),
    ],
)
def test_operands_on_two_devices_are_refused(cuda, mixture):
    with pytest.raises(RuntimeError, match="same device"):
        mixture(torch.ones(3, device=DEVICE), torch.ones(3))


def test_the_device_follows_views_and_copies(cuda):
    tensor = torch.arange(6, device=DEVICE).view(2, 3)
    for other in (tensor[0], tensor.T, tensor + 1, torch.zeros_like(tensor), tensor.new_ones(2)):
        assert other.device == torch.device(DEVICE)
        assert other.is_cuda
    assert tensor.cpu().device.type == "cpu"
    assert torch.zeros(2).to(tensor).is_cuda
    assert (tensor * torch.tensor(2)).is_cuda
    with pytest.raises(TypeError, match="numpy"):
        tensor.numpy()
    with pytest.raises(TypeError, match="numpy"):
        np.asarray(tensor)


def test_waits_are_counted(cuda):
    tensor = torch.arange(3.0, device=DEVICE)
    tensor[tensor > 1] = 0.0
    tensor.sum()
    assert not cuda.waits
    for waiting in (
        lambda: tensor.sum().item(),
        lambda: bool(tensor.any()),
        lambda: tensor.nonzero(),
        lambda: tensor[tensor > 1],
        lambda: tensor.cpu(),
        lambda: torch.tensor([1.0], device=DEVICE),
        lambda: torch.zeros(3).to(DEVICE),
        lambda: tensor.copy_(torch.zeros(3)),
    ):
        cuda.waits.clear()
        waiting()
        assert cuda.waits.total() == 1


# Tasks.


@pytest.mark.parametrize("task", list_tasks())
def test_a_task_builds_steps_and_resets_on_the_device(cuda, task):
    env = make_env(task)
    observations, _ = env.reset()
    actions = torch.zeros(NUM_ENVS, env.action_manager.total_action_dim, device=DEVICE)
    env.step(actions)
    cuda.waits.clear()
    cuda.rounded.clear()
    env.step(actions)
    waits = {re.sub(r":\d+ ", " ", place): count for place, count in cuda.waits.items()}
    assert waits.keys() <= LOOKED_UP
    assert set(waits.values()) == {1}
    # Some episodes end, and the others go on.
    env.episode_length_buf[:2] = 10**9
    without = cuda.waits.total()
    cuda.waits.clear()
    observations, *returned, extras = env.step(actions)
    drawn_again = sum(n for place, n in cuda.waits.items() if " keep_apart: " in place)
    assert cuda.waits.total() - without - drawn_again <= MOST_WAITS_OF_RESETS, cuda.waits
    assert not cuda.rounded, "TF32 may round these; use sums of products"
    assert (returned[-1].cpu() == torch.tensor([True, True, False, False])).all()
    for value in (*observations.values(), *returned):
        assert is_marked(value)
    env.reset(env_ids=torch.tensor([1]))
    env.load_state_dict(env.state_dict())
    env.sim.copy_to_host(1)
    env.close()


def test_an_array_of_actions_goes_to_the_device(cuda):
    assert is_marked(as_action(np.zeros((2, 1)), DEVICE))
    assert is_marked(as_action(torch.zeros(2, 1), DEVICE))


@pytest.mark.parametrize(
    "task",
    [
        pytest.param(task, marks=() if task in LEARNED else pytest.mark.slow)
        for task in list_tasks()
    ],
)
def test_a_task_is_learned_saved_resumed_and_scored_on_the_device(cuda, task, tmp_path: Path):
    cfg = load_rl_cfg(task)
    cfg.num_steps_per_env, cfg.evaluation.num_episodes = 4, 2
    runner_cls = load_runner_cls(task) or MjlabOnPolicyRunner

    def make_runner():
        env = RslRlVecEnvWrapper(make_env(task, EPISODE_STEPS))
        return runner_cls(env, asdict(cfg), str(tmp_path), DEVICE)

    runner = make_runner()
    runner.learn(1)
    assert all(is_marked(parameter) for parameter in runner.alg.actor.parameters())
    path = str(tmp_path / "again.pt")
    runner.save(path)
    resumed = make_runner()
    resumed.load(path)
    resumed.learn(2)
    assert resumed.current_learning_iteration == 2
    assert resumed.evaluate().mean_length > 0
    assert all(is_marked(parameter) for parameter in resumed.alg.actor.parameters())
