"""Memory check: errors beyond the total, warnings beyond what is available, both before allocation."""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import pytest
import torch
from tensordict import TensorDict

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.rl.learners import train_dict, with_learner
from mjlab.rl.replay import ReplayStorage
from mjlab.sim import Simulation, SimulationCfg
from mjlab.sim.native.engine import NativeEngine
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.utils import memory, processes
from mjlab.utils.buffers import CircularBuffer
from mjlab.utils.memory import check_memory

CARTPOLE = "Mjlab-Cartpole-Balance"
GB = 10**9


@pytest.fixture
def machine(monkeypatch, tmp_path):
    """Return a function that sets the memory reported by the system (bytes)."""

    def pretend(total=None, available=None, swap=0, group=None, used=0, cached=0, version=2):
        monkeypatch.setattr(memory, "_PROCESS", tmp_path)
        monkeypatch.setattr(memory, "_SMALL", 0)
        monkeypatch.setattr(processes, "_OWN_CGROUPS", tmp_path / "cgroup")
        monkeypatch.setattr(processes, "_CGROUP_ROOT", tmp_path / "fs")
        (tmp_path / "meminfo").unlink(missing_ok=True)
        if total is not None:
            free = total if available is None else available
            sizes = {"MemTotal": total, "MemAvailable": free, "SwapTotal": swap, "SwapFree": swap}
            lines = [f"{name}: {size // 1024} kB" for name, size in sizes.items()]
            (tmp_path / "meminfo").write_text("\n".join(lines))
        (tmp_path / "cgroup").write_text("0::/a/b\n" if version == 2 else "4:memory:/a/b\n")
        folder = tmp_path / "fs" / ("a" if version == 2 else "memory/a")
        folder.mkdir(parents=True, exist_ok=True)
        limit, usage, prefix = memory._GROUP_FILES[version]
        (folder / limit).write_text("max\n" if group is None else f"{group}\n")
        (folder / usage).write_text(f"{used}\n")
        stat = f"{prefix}active_file {cached}\n{prefix}inactive_file 0\n"
        (folder / "memory.stat").write_text(stat)

    return pretend


@pytest.fixture(scope="module")
def env():
    cfg = load_env_cfg(CARTPOLE)
    cfg.scene.num_envs = 4
    return RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg, device="cpu"))


def items(count: int, size: int = GB) -> bool:
    return check_memory("Items", count, size, "cpu", "fewer items")


@pytest.mark.parametrize(
    "sizes",
    [
        {"total": 8 * GB},
        {"total": 6 * GB, "swap": 2 * GB},
        {"total": 64 * GB, "group": 8 * GB},
        {"total": 64 * GB, "group": 8 * GB, "version": 1},
    ],
)
def test_the_smallest_total_is_the_limit(machine, sizes):
    machine(**sizes)
    assert items(7)
    with pytest.raises(
        ValueError, match=r"Items: expected at most 8 .*got 9 .*9.0 GB.*fewer items"
    ):
        items(9)


@pytest.mark.parametrize(
    "sizes",
    [
        {"total": 8 * GB, "available": 4 * GB},
        {"total": 64 * GB, "group": 8 * GB, "used": 6 * GB, "cached": 2 * GB},
        {"total": 64 * GB, "group": 8 * GB, "used": 6 * GB, "cached": 2 * GB, "version": 1},
    ],
)
def test_more_than_is_available_warns(machine, sizes, recwarn):
    machine(**sizes)
    assert items(3)
    assert not recwarn
    with pytest.warns(UserWarning, match=r"Items: expected about 4 .*got 6 .*fewer items"):
        assert not items(6)


def test_processes_share_the_memory(machine, monkeypatch):
    machine(total=8 * GB)
    monkeypatch.setenv("WORLD_SIZE", "4")
    monkeypatch.setenv("RANK", "0")
    assert items(1)
    with pytest.raises(ValueError, match="expected at most 2 "):
        items(3)


def test_unknown_memory_is_unlimited(machine):
    machine()
    assert items(10**30)


def test_address_space_limits(machine, monkeypatch):
    machine(total=64 * GB)
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (8 * GB, 8 * GB))
    (memory._PROCESS / "self").mkdir()
    (memory._PROCESS / "self" / "status").write_text(f"VmSize:\t{4 * GB // 1024} kB\n")
    assert items(3)
    with pytest.warns(UserWarning, match="available"):
        items(5)
    with pytest.raises(ValueError, match="at most 8 "):
        items(9)


# Estimates are lower bounds.


TAKEN = """
import sys
import torch
from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.registry import load_env_cfg

def taken(num_envs):
    cfg = load_env_cfg(sys.argv[1])
    cfg.scene.num_envs, cfg.sim.engine = num_envs, sys.argv[2]
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    env.step(torch.zeros(num_envs, env.action_manager.total_action_dim))
    return env, int(open("/proc/self/statm").read().split()[1]) * 4096

small, before = taken(2)
large, after = taken(int(sys.argv[3]))
print((after - before) / large.num_envs, large.sim._engine.bytes_each)
"""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="resident memory is unknown")
@pytest.mark.parametrize(
    ("task", "engine", "num_envs"),
    [
        pytest.param(CARTPOLE, "native", 32_768, marks=pytest.mark.slow),
        ("Mjlab-Velocity-Flat-Unitree-Go1", "native", 512),
        pytest.param(CARTPOLE, "warp", 2048, marks=pytest.mark.slow),
    ],
)
def test_environments_take_what_is_reserved(task, engine, num_envs):
    command = [sys.executable, "-c", TAKEN, task, engine, str(num_envs)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    taken, reserved = map(float, said.splitlines()[-1].split())
    assert 0.5 * taken < reserved < taken


@pytest.mark.parametrize(
    ("learner", "change", "named"),
    [
        ("ppo", {"actor": {"hidden_dims": (30_000, 30_000)}}, "agent.actor weights"),
        ("ppo", {"critic": {"hidden_dims": (10**10, 10**10)}}, "agent.critic weights"),
        ("distillation", {"student": {"hidden_dims": (30_000, 30_000)}}, "agent.student weights"),
        ("sac", {"actor": {"hidden_dims": (10**20,)}}, "agent.actor weights"),
        ("ppo", {"num_steps_per_env": 10**12}, "num_steps_per_env"),
        ("ppo", {"num_steps_per_env": 10**30}, "num_steps_per_env"),
        ("sac", {"algorithm": {"replay_steps": 10**9}}, "replay_steps"),
        ("sac", {"algorithm": {"batch_size": 10**9}}, "batch_size"),
    ],
)
def test_learners_beyond_the_memory(machine, env, learner, change, named):
    cfg = train_dict(with_learner(load_rl_cfg(CARTPOLE), learner))
    for name, value in change.items():
        cfg[name] = {**cfg[name], **value} if isinstance(value, dict) else value
    machine(total=3 * GB)
    begin = time.monotonic()
    with pytest.raises(ValueError, match=f"{named}.*use (fewer|smaller|a smaller)"):
        MjlabOnPolicyRunner(env, cfg, device="cpu")
    assert time.monotonic() - begin < 10.0


def test_training_takes_two_to_four_times_the_weights(machine, env):
    cfg = train_dict(load_rl_cfg(CARTPOLE))
    runner = MjlabOnPolicyRunner(env, cfg, device="cpu")
    machine(total=4 * 4 * 9000)
    with pytest.warns(UserWarning, match="trained weights: expected about 8,9.*got 9,219"):
        runner.learn(0)
    machine(total=2 * 4 * 9000)
    with pytest.raises(ValueError, match="trained weights: expected at most 8,9.*got 9,219"):
        runner.learn(1)


def test_replay_and_rollout_estimates(machine, env):
    """The largest number of steps that the message allows takes about the memory."""
    machine(total=10**6)
    observations = env.get_observations()
    for learner, steps in (("ppo", "num_steps_per_env"), ("sac", "replay_steps")):
        cfg = train_dict(with_learner(load_rl_cfg(CARTPOLE), learner))
        for name in ("actor", "critic"):
            cfg[name]["hidden_dims"] = (8,)
        (cfg["algorithm"] if learner == "sac" else cfg)[steps] = 10**6
        with pytest.raises(ValueError, match=f"{steps}: expected at most") as caught:
            MjlabOnPolicyRunner(env, cfg, device="cpu")
        most = int(str(caught.value).split("at most ")[1].split()[0].replace(",", ""))
        (cfg["algorithm"] if learner == "sac" else cfg)[steps] = most
        storage = MjlabOnPolicyRunner(env, cfg, device="cpu").alg.storage
        assert isinstance(observations, TensorDict)
        if isinstance(storage, ReplayStorage):
            assert 0.9e6 < storage.num_bytes < 1.1e6
        else:
            values = [value for value in vars(storage).values() if torch.is_tensor(value)]
            values += storage.observations.values()
            assert 0.9e6 < sum(value.nbytes for value in values) < 2e6


# Other sizes.


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_simulations_beyond_the_memory(machine, engine):
    xml = "<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(xml)
    cfg = SimulationCfg(engine=engine, nconmax=4, njmax=8)
    machine(total=10**7)
    sim = Simulation(2, cfg, model, device="cpu")
    most = 10**7 // sim._engine.bytes_each
    with pytest.raises(ValueError, match=f"num_envs: expected at most {most // 1000},.*fewer"):
        Simulation(2 * most, cfg, model, device="cpu")


def test_expanded_fields_count(machine):
    spec = mujoco.MjSpec()
    for _ in range(100):
        spec.worldbody.add_geom(size=(0.1, 0.0, 0.0), contype=0, conaffinity=0)
    machine(total=10**6)
    sim = Simulation(100, SimulationCfg(engine="native"), spec.compile(), device="cpu")
    assert isinstance(sim._engine, NativeEngine)
    before = sim._engine.bytes_each
    sim.expand_model_fields(("geom_friction",))
    # In double precision, with two copies in single precision.
    assert sim._engine.bytes_each - before == 100 * 3 * (8 + 4 + 4)
    with pytest.raises(ValueError, match="num_envs: expected at most"):
        sim.expand_model_fields(("geom_pos", "geom_quat", "geom_rgba", "geom_size"))


def test_environments_warn_once(machine, recwarn):
    machine(total=10**9, available=10**5)
    cfg = load_env_cfg(CARTPOLE)
    cfg.scene.num_envs = 1000
    ManagerBasedRlEnv(cfg, device="cpu")
    told = [str(one.message) for one in recwarn if "num_envs" in str(one.message)]
    assert len(told) == 1


def test_histories_beyond_the_memory(machine):
    machine(total=10**6)
    with pytest.raises(ValueError, match="at most 2,49.*shorter history"):
        CircularBuffer(10**9, 10, "cpu").append(torch.zeros(10, 10))
