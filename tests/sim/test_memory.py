"""Memory check: too many environments raise before allocation, all others pass."""

from __future__ import annotations

import time

import mujoco
import pytest

from mjlab.envs import ManagerBasedRlEnv
from mjlab.sim import Simulation, SimulationCfg, memory
from mjlab.sim.memory import available_memory, bytes_per_environment
from mjlab.tasks.registry import load_env_cfg

SLIDER = "<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>"
MODEL = mujoco.MjModel.from_xml_string(SLIDER)


@pytest.fixture
def memory_of(monkeypatch, tmp_path):
    """Return a function that sets the memory reported by the system (bytes); None: unknown."""

    def pretend(free: int | None, group: str = "max", swap: int = 0) -> None:
        if free is not None:
            lines = f"MemAvailable: {free // 1024} kB\nSwapFree: {swap // 1024} kB\nHugePages: 0\n"
            (tmp_path / "meminfo").write_text(lines)
        (tmp_path / "cgroup").write_text("0::/a/b\n")
        (tmp_path / "groups" / "a" / "b").mkdir(parents=True)
        (tmp_path / "groups" / "a" / "memory.max").write_text(f"{group}\n")
        monkeypatch.setattr(memory, "_MEMORY", tmp_path / "meminfo")
        monkeypatch.setattr(memory, "_OWN_GROUPS", tmp_path / "cgroup")
        monkeypatch.setattr(memory, "_GROUPS", tmp_path / "groups")

    return pretend


@pytest.mark.parametrize(
    ("sizes", "expected"),
    [
        ((2**30,), 2**30),
        ((2**30, "max", 2**20), 2**30 + 2**20),
        ((2**30, str(2**25)), 2**25),
        ((None,), None),
    ],
)
def test_what_is_free_is_limited_by_the_control_group(memory_of, sizes, expected):
    memory_of(*sizes)
    assert available_memory("cpu") == expected


def test_the_largest_number_that_may_fit_is_told_and_not_refused(memory_of):
    cfg = SimulationCfg(engine="native")
    each = bytes_per_environment(MODEL, cfg, "native")
    memory_of(1024 * each)
    Simulation(1024, cfg, MODEL, device="cpu")
    with pytest.raises(ValueError, match=r"at most 1,024\b.*got 1,025\b.* each"):
        Simulation(1025, cfg, MODEL, device="cpu")


def test_a_billion_environments_are_refused_at_once():
    cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
    cfg.scene.num_envs = 10**10
    begin = time.monotonic()
    with pytest.raises(ValueError, match="num_envs: expected at most .* got 10,000,000,000"):
        ManagerBasedRlEnv(cfg, device="cpu")
    assert time.monotonic() - begin < 20.0


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_the_estimate_is_below_what_is_taken(engine):
    cfg = SimulationCfg(engine=engine, njmax=64, nconmax=16)
    sim = Simulation(512, cfg, MODEL, device="cpu")
    if engine == "native":
        taken = 2 * sim._engine._batch.state.nbytes
    else:
        taken = 0
        for holder in (sim.wp_data, sim.wp_data.efc, sim.wp_data.contact):
            arrays = [getattr(holder, name) for name in vars(holder)]
            taken += sum(a.size * 4 for a in arrays if hasattr(a, "strides"))
    own = bytes_per_environment(MODEL, cfg, engine) - memory.LEAST_BYTES
    assert own <= taken / 512 + 4 * (MODEL.nq + MODEL.nv)
