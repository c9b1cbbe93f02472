"""The code of `docs/tutorial/cartpole.md` is taken from the page, put into a package, and run."""

from __future__ import annotations

import importlib
import os
import re
import runpy
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks import registry

PAGE = Path(__file__).resolve().parents[2] / "docs" / "tutorial" / "cartpole.md"
NUM_ENVS = 4

_BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_OTHER_FILE = re.compile(r"# my_tasks/(\S+)\n")


def _blocks(language: str) -> list[str]:
    found = _BLOCK.findall(PAGE.read_text(encoding="utf-8"))
    return [text for name, text in found if name == language]


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The tutorial's package `my_tasks`, importable.

    Python blocks belong to `my_cartpole.py` unless their first line names another file, as the page
    says.
    """
    folder = tmp_path_factory.mktemp("tutorial")
    package = folder / "my_tasks"
    package.mkdir()
    module: list[str] = []
    for text in _blocks("python"):
        other = _OTHER_FILE.match(text)
        if other:
            (package / other.group(1)).write_text(text, encoding="utf-8")
        else:
            module.append(text)
    (package / "my_cartpole.py").write_text("\n\n".join(module), encoding="utf-8")
    (xml,) = _blocks("xml")
    (package / "cartpole.xml").write_text(xml, encoding="utf-8")
    # What an installer makes of the page's pyproject.toml.
    (toml,) = _blocks("toml")
    project = tomllib.loads(toml)["project"]
    info = folder / f"my_tasks-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    entries = project["entry-points"]["mjlab.tasks"]
    lines = [f"{name} = {value}" for name, value in entries.items()]
    (info / "entry_points.txt").write_text("\n".join(["[mjlab.tasks]", *lines, ""]))
    # What is found once stays for all tests, what the package registers only for those here.
    registry.list_tasks()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "_tasks", dict(registry._tasks))
        patch.syspath_prepend(str(folder))
        yield package
    for name in [name for name in sys.modules if name.split(".")[0] == "my_tasks"]:
        del sys.modules[name]


@pytest.fixture(scope="module")
def my_cartpole(package: Path) -> ModuleType:
    return importlib.import_module("my_tasks.my_cartpole")


def _build(cfg: Any) -> Any:
    cfg.scene.num_envs = NUM_ENVS
    cfg.seed = 0
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    return env


def test_the_environment_steps_and_starts_hanging_down(my_cartpole: ModuleType) -> None:
    env = _build(my_cartpole.cartpole_env_cfg())
    observations, reward, terminated, truncated, _ = env.step(torch.zeros(NUM_ENVS, 1))
    env.close()
    assert env.max_episode_length == 1000
    assert observations["actor"].shape == observations["critic"].shape == (NUM_ENVS, 5)
    torch.testing.assert_close(observations["actor"], observations["critic"])
    # Cosine of the pole's angle.
    assert (observations["actor"][:, 1] < -0.99).all()
    assert (reward >= 0).all()
    assert not (terminated | truncated).any()


def test_upright_and_at_rest_the_reward_is_that_of_a_full_step(my_cartpole: ModuleType) -> None:
    cfg = my_cartpole.cartpole_env_cfg(swing_up=False)
    cfg.events = {}
    env = _build(cfg)
    _, reward, *_ = env.step(torch.zeros(NUM_ENVS, 1))
    env.close()
    torch.testing.assert_close(reward, torch.full((NUM_ENVS,), env.step_dt))


def test_the_reward_is_that_of_the_task_that_ships_with_mjlab(my_cartpole: ModuleType) -> None:
    from mjlab.tasks.cartpole.cartpole_env_cfg import cartpole_smooth_reward

    env = _build(my_cartpole.cartpole_env_cfg())
    generator = torch.Generator().manual_seed(1)
    for _ in range(5):
        env.step(2.0 * torch.rand(NUM_ENVS, 1, generator=generator) - 1.0)
    params = env.reward_manager.get_term_cfg("smooth_reward").params
    ours = my_cartpole.cartpole_smooth_reward(env, **params)
    torch.testing.assert_close(ours, cartpole_smooth_reward(env, **params))
    env.close()


def test_noise_reaches_the_actor_only(my_cartpole: ModuleType) -> None:
    cfg = my_cartpole.cartpole_env_cfg()
    my_cartpole.add_noise(cfg)
    env = _build(cfg)
    observations, *_ = env.step(torch.zeros(NUM_ENVS, 1))
    env.close()
    difference = (observations["actor"] - observations["critic"]).abs()
    # Cart position, cosine, sine, cart velocity, pole velocity.
    assert (difference[:, [0, 4]] > 0).all()
    assert difference[:, 0].max() <= 0.05
    assert (difference[:, 1:4] == 0).all()


def test_each_environment_gets_a_pole_and_dampings_of_its_own(my_cartpole: ModuleType) -> None:
    env = _build(my_cartpole.robust_cartpole_env_cfg())
    pole = int(env.scene["cartpole"].data.indexing.body_ids[-1])
    masses, damping = env.sim.model.body_mass[:, pole], env.sim.model.dof_damping
    ratio = masses / env.sim.get_default_field("body_mass")[pole]
    factors = damping / env.sim.get_default_field("dof_damping")
    env.close()
    assert len(ratio.unique()) == NUM_ENVS
    # The page says by 0.80 to 1.25.
    assert ratio.min() > 0.80
    assert ratio.max() < 1.25
    assert factors.min() >= 0.5
    assert factors.max() <= 2.0
    assert len(factors.unique()) == factors.numel()


_LOOK_UP = """
import sys
from mjlab.tasks import registry

task = "My-Cartpole-Swingup"
assert task in registry.list_tasks()
assert "my_tasks.my_cartpole" not in sys.modules, "listing the tasks imports the module"
assert "torch" not in sys.modules, "listing the tasks imports torch"
assert registry.load_env_cfg(task).episode_length_s == 50.0
assert registry.load_env_cfg(task, play=True).episode_length_s == 1e10
assert registry.load_rl_cfg(task).experiment_name == "my_cartpole"
"""


def test_the_entry_point_makes_the_task_known(package: Path) -> None:
    # In a process of its own, because entry points are looked up once.
    paths = [str(package.parent), os.environ.get("PYTHONPATH", "")]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    command = [sys.executable, "-c", _LOOK_UP]
    looked = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert looked.returncode == 0, looked.stderr


def test_the_learner_trains_it_for_an_iteration(my_cartpole: ModuleType, tmp_path: Path) -> None:
    from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper

    env = RslRlVecEnvWrapper(_build(my_cartpole.cartpole_env_cfg()))
    cfg = my_cartpole.cartpole_ppo_runner_cfg()
    cfg.num_steps_per_env = 8
    runner = MjlabOnPolicyRunner(env, asdict(cfg), str(tmp_path), "cpu")
    runner.learn(1)
    env.close()
    assert (tmp_path / "model_0.pt").is_file()


def test_the_file_runs_by_itself(package: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(package / "my_cartpole.py"), run_name="__main__")
    printed = capsys.readouterr().out
    assert "actor observations: (4, 5)" in printed
    assert "reward:" in printed
