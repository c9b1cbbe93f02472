"""All tasks run on a CUDA device: no tensor stays on the host or is fetched from there.

The tests need no GPU; `pretend_cuda` enforces the rules of one.
"""

from __future__ import annotations

import copy
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers import EventTermCfg
from mjlab.managers.action_manager import as_action
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.tasks.registry import list_tasks, load_env_cfg, load_rl_cfg, load_runner_cls
from mjlab.tasks.tracking.mdp import MotionCommand, MotionCommandCfg

from .pretend_cuda import DEVICE, PretendCuda, install, is_marked

NUM_ENVS = 4
# A step with resets also draws from ranges of the config that it copies to the device, counts
# failures of motions, and logs metrics and levels of terrain.
MOST_WAITS_OF_RESETS = 5
# With mirror images, and with what the runner of tracking does besides.
LEARNED = ("Mjlab-Velocity-Flat-Unitree-Go1", "Mjlab-Tracking-Flat-Unitree-G1")
# With an interval event, a command that places objects, and a command with a separate clock.
COMPARED = (
    "Mjlab-Velocity-Flat-Unitree-Go1",
    "Mjlab-Lift-Cube-Yam",
    "Mjlab-Tracking-Flat-Unitree-G1",
)
EPISODE_STEPS = 6


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> Iterator[PretendCuda]:
    mode = PretendCuda()
    install(monkeypatch, mode)
    with mode:
        yield mode


def make_cfg(task: str, episode_steps: int | None = None) -> ManagerBasedRlEnvCfg:
    cfg = load_env_cfg(task)
    cfg.scene.num_envs, cfg.seed = NUM_ENVS, 1
    if episode_steps is not None:
        cfg.episode_length_s = episode_steps * cfg.decimation * cfg.sim.mujoco.timestep
    if cfg.scene.terrain and cfg.scene.terrain.terrain_generator:
        cfg.scene.terrain.terrain_generator.num_rows = 2
        cfg.scene.terrain.terrain_generator.num_cols = 2
    return cfg


def make_env(task: str, episode_steps: int | None = None) -> ManagerBasedRlEnv:
    return ManagerBasedRlEnv(make_cfg(task, episode_steps), device=DEVICE)


def make_due(env: ManagerBasedRlEnv, ids: slice) -> None:
    """Let interval events happen in these environments, and commands be drawn, in the next step."""
    for timer in env.event_manager._timers.values():
        timer[ids] = 0.0
    for name in env.command_manager.active_terms:
        if not isinstance(command := env.command_manager.get_term(name), MotionCommand):
            command.time_left[ids] = 0.0


def counted(cuda: PretendCuda) -> Counter[str]:
    """Return the waits by place, and zero all.

    Left out are those that draw until objects are apart, and those for rays that hit no ground.
    """
    waits = Counter[str]()
    for place, count in cuda.waits.items():
        if " keep_apart: " not in place and " _zero_below_ground: " not in place:
            waits[re.sub(r":\d+ ", " ", place)] += count
    cuda.waits.clear()
    return waits


# Simulated device.


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


def lookups(env: ManagerBasedRlEnv) -> int:
    """Return the number of masks of a step: ends, and what is due."""
    commands = [env.command_manager.get_term(name) for name in env.command_manager.active_terms]
    motions = sum(isinstance(command, MotionCommand) for command in commands)
    timers = sum(isinstance(timer, torch.Tensor) for timer in env.event_manager._timers.values())
    return 1 + env.observes_ends + len(commands) + motions + timers


# Tasks.


@pytest.mark.parametrize("task", list_tasks())
def test_a_task_builds_steps_and_resets_on_the_device(cuda, task):
    env = make_env(task)
    env.observes_ends = True
    observations, _ = env.reset()
    actions = torch.zeros(NUM_ENVS, env.action_manager.total_action_dim, device=DEVICE)
    env.step(actions)
    # Ranges of events are copied to the device by the first draw.
    make_due(env, slice(None))
    env.step(actions)
    cuda.waits.clear()
    cuda.rounded.clear()
    for due in (slice(0), slice(1, 3)):
        make_due(env, due)
        env.step(actions)
        waits = counted(cuda)
        assert all(place.endswith("nonzero") for place in waits), waits
        assert waits.total() == lookups(env), waits
    # Some episodes end, and the others go on.
    make_due(env, slice(1, 3))
    env.episode_length_buf[:2] = 10**9
    observations, *returned, extras = env.step(actions)
    waits = counted(cuda)
    assert waits.total() <= lookups(env) + MOST_WAITS_OF_RESETS, waits
    assert not cuda.rounded, "TF32 may round these; use sums of products"
    assert (returned[-1].cpu() == torch.tensor([True, True, False, False])).all()
    final = extras["final_observations"]
    timed_out = env.reset_time_outs & ~env.reset_terminated
    assert extras["final_ids"].tolist() == timed_out.nonzero().flatten().tolist() != []
    for value in (*observations.values(), *returned, extras["final_ids"], *final.values()):
        assert is_marked(value)
    env.reset(env_ids=torch.tensor([1]))
    env.load_state_dict(env.state_dict())
    env.sim.copy_to_host(1)
    env.close()


def test_a_timer_for_all_environments_is_not_drawn_on_the_device(cuda):
    cfg = make_cfg("Mjlab-Cartpole-Balance")
    cfg.events["all"] = EventTermCfg(
        func=lambda env, env_ids: None,
        mode="interval",
        interval_range_s=(0.0, 0.0),
        is_global_time=True,
    )
    env = ManagerBasedRlEnv(cfg, device=DEVICE)
    env.reset()
    actions = torch.zeros(NUM_ENVS, 1, device=DEVICE)
    env.step(actions)
    cuda.waits.clear()
    env.step(actions)
    assert counted(cuda).total() == lookups(env)
    env.close()


@pytest.mark.parametrize("task", COMPARED)
def test_a_step_is_the_same_on_both_devices(cuda, task):
    cfg = make_cfg(task, EPISODE_STEPS)
    # Motions may be over within an episode.
    cfg.terminations["motion_ended"] = None
    for event in cfg.events.values():
        if event.mode == "interval":
            event.interval_range_s = (0.03, 0.1)
    for command in cfg.commands.values():
        if not isinstance(command, MotionCommandCfg):
            command.resampling_time_range = (0.0, 0.1)
    steps = {}
    for device in ("cpu", DEVICE):
        env = ManagerBasedRlEnv(copy.deepcopy(cfg), device=device)
        env.reset()
        actions = torch.ones(NUM_ENVS, env.action_manager.total_action_dim, device=device)
        steps[device] = []
        for _ in range(2 * EPISODE_STEPS + 3):
            with torch.inference_mode():
                observations, reward, *_ = env.step(actions)
            counts = [term.command_counter for term in env.command_manager._terms.values()]
            values = (*observations.values(), reward, env.sim.data.qvel, *counts)
            steps[device].append([value.cpu().clone() for value in values])
        env.close()
    for on_cpu, on_cuda in zip(*steps.values(), strict=True):
        assert all(map(torch.equal, on_cpu, on_cuda))


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
