"""Tasks of other installed packages, discovered through entry points."""

from __future__ import annotations

import importlib
import logging
import re
import sys
import textwrap
import tomllib
import types
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from mjlab import compat
from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks import registry


@pytest.fixture
def install(tmp_path, monkeypatch) -> Callable[..., None]:
    """Return a function that installs a package with entry points in the group `mjlab.tasks`."""
    site = tmp_path / "site-packages"
    site.mkdir()
    monkeypatch.syspath_prepend(str(site))
    registry.list_tasks()
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))
    monkeypatch.setattr(registry, "_discovered", False)
    installed: set[str] = set()
    compat._warn_once.cache_clear()

    def install(name: str, entry_points: dict[str, str], files: dict[str, str]) -> None:
        for path, text in files.items():
            installed.add(Path(path).parts[0].removesuffix(".py"))
            (site / path).parent.mkdir(parents=True, exist_ok=True)
            (site / path).write_text(textwrap.dedent(text))
        info = site / f"{name}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        lines = [f"{key} = {value}" for key, value in entry_points.items()]
        (info / "entry_points.txt").write_text("\n".join(["[mjlab.tasks]", *lines]) + "\n")
        importlib.invalidate_caches()

    yield install
    for name in [name for name in sys.modules if name.split(".")[0] in installed]:
        del sys.modules[name]
    compat._warn_once.cache_clear()


REGISTERS = """
    from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, register_mjlab_task

    def register():
        cfg = load_env_cfg("Mjlab-Cartpole-Balance")
        cfg.rewards["smooth_reward"].weight = 3.0
        register_mjlab_task(
            task_id="{task}",
            env_cfg=cfg,
            play_env_cfg=load_env_cfg("Mjlab-Cartpole-Balance", play=True),
            rl_cfg=load_rl_cfg("Mjlab-Cartpole-Balance"),
        )
"""


@pytest.mark.parametrize(
    ("value", "path"),
    [
        ("their_tasks", "their_tasks/__init__.py"),
        ("their_tasks", "their_tasks.py"),
        ("their_tasks.cartpole", "their_tasks/cartpole.py"),
        ("their_tasks:register", "their_tasks.py"),
        ("their_tasks.sub:TASKS", "their_tasks/sub/__init__.py"),
    ],
)
def test_an_entry_point_may_name_a_module_or_something_in_it(install, value, path):
    text = textwrap.dedent(REGISTERS.format(task="Their-Task")) + "\nregister()\nTASKS = ['x']\n"
    install("their-package", {"any_name": value}, {path: text})
    assert "Their-Task" in registry.list_tasks()
    assert str(registry.task_source("Their-Task")).endswith(path)
    assert "Mjlab-Cartpole-Swingup" in registry.list_tasks()
    assert registry.load_env_cfg("Their-Task").rewards["smooth_reward"].weight == 3.0
    assert registry.load_env_cfg("Mjlab-Cartpole-Balance").rewards["smooth_reward"].weight == 1.0


def test_a_package_is_imported_once_and_only_when_tasks_are_asked_for(install):
    install("their-package", {"tasks": "their_counting"}, {"their_counting.py": "COUNT = [1]\n"})
    assert "their_counting" not in sys.modules
    registry.list_tasks()
    module = sys.modules["their_counting"]
    registry.list_tasks()
    assert sys.modules["their_counting"] is module


@pytest.mark.parametrize(
    ("value", "text", "told"),
    [
        ("broken", "import no_such_module_anywhere", "No module named 'no_such_module_anywhere'"),
        ("broken", "raise RuntimeError('their mistake')", "their mistake"),
        ("broken", "def (", "SyntaxError"),
        ("broken", "import sys; sys.exit('they leave')", "they leave"),
        ("broken:missing", "", "missing"),
        ("not_installed_at_all", "", "No module named 'not_installed_at_all'"),
        (
            "broken",
            textwrap.dedent(REGISTERS.format(task="Mjlab-Cartpole-Balance")) + "\nregister()\n",
            "registered already",
        ),
    ],
)
def test_a_broken_package_is_reported_and_skipped(install, caplog, value, text, told):
    install("broken-package", {"first": value}, {"broken.py": text})
    working = textwrap.dedent(REGISTERS.format(task="Working-Task")) + "\nregister()\n"
    install("working-package", {"second": "working"}, {"working.py": working})
    with caplog.at_level(logging.ERROR, logger="mjlab"):
        tasks = registry.list_tasks()
    assert "Working-Task" in tasks
    assert "Mjlab-Cartpole-Balance" in tasks
    (record,) = caplog.records
    for part in ("'first'", value, told):
        assert part in record.getMessage()
    assert ("broken.py" in record.getMessage()) == ("not_installed" not in value and text != "")
    assert "importlib" not in record.getMessage()
    assert "mjlab[compat]" not in record.getMessage()


def _modules_of_the_extra() -> list[str]:
    pyproject = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    extra = pyproject["project"]["optional-dependencies"]["compat"]
    return [re.split(r"[^\w]", requirement)[0] for requirement in extra]


@pytest.mark.parametrize("module", _modules_of_the_extra())
@pytest.mark.parametrize(
    "text",
    [
        "import {module}",
        "from {module}.sub import thing",
        "try:\n    import {module}\nexcept ImportError as e:\n    raise RuntimeError('no') from e",
    ],
)
def test_a_package_that_misses_a_module_of_the_extra_is_told_the_extra(
    install, caplog, monkeypatch, module, text
):
    # An entry of None makes the import fail, also where the extra is installed.
    monkeypatch.setitem(sys.modules, module, None)
    install("their-package", {"first": "broken"}, {"broken.py": text.format(module=module)})
    registry.list_tasks()
    (record,) = caplog.records
    assert f"{module} comes with the extra mjlab[compat]" in record.getMessage()


def test_a_part_that_an_installed_module_lacks_is_no_missing_module(install, caplog, monkeypatch):
    """As for `moviepy.editor`, removed in moviepy 2."""
    package = types.ModuleType("moviepy")
    package.__path__ = []
    monkeypatch.setitem(sys.modules, "moviepy", package)
    install("their-package", {"first": "broken"}, {"broken.py": "import moviepy.editor"})
    registry.list_tasks()
    (record,) = caplog.records
    assert "moviepy.editor" in record.getMessage()
    assert "mjlab[compat]" not in record.getMessage()


def test_a_task_whose_config_misses_such_a_module_is_told_the_extra_too(install, monkeypatch):
    monkeypatch.setitem(sys.modules, "mediapy", None)
    install("their-package", {}, {"their_configs.py": "import mediapy"})
    registry.register_mjlab_task("Their-Task", "their_configs:make", rl_cfg="their_configs:make")
    with pytest.raises(registry.TaskImportError, match=r"mjlab\[compat\]"):
        registry.load_env_cfg("Their-Task")


def test_a_package_that_fails_half_way_leaves_none_of_its_tasks(install, caplog):
    text = textwrap.dedent(REGISTERS.format(task="Half-Task")) + "\nregister()\nimport nowhere\n"
    install("broken-package", {"first": "broken"}, {"broken.py": text})
    tasks = registry.list_tasks()
    assert "Half-Task" not in tasks
    assert "Mjlab-Cartpole-Balance" in tasks
    assert "No module named 'nowhere'" in caplog.text
    with pytest.raises(registry.UnknownTaskError):
        registry.load_env_cfg("Half-Task")


OLD_STYLE = {
    "old_style/__init__.py": "",
    "old_style/tasks/__init__.py": """
        from mjlab.tasks.registry import register_mjlab_task

        from .env_cfg import env_cfg, rl_cfg

        register_mjlab_task(
            task_id="Old-Style-Cartpole",
            env_cfg=env_cfg(),
            play_env_cfg=env_cfg(play=True),
            rl_cfg=rl_cfg(),
        )
    """,
    "old_style/mdp/__init__.py": """
        from mjlab.envs.mdp import *  # noqa: F403

        from .rewards import *  # noqa: F403
    """,
    "old_style/mdp/rewards.py": """
        import torch

        from mjlab.entity import Entity
        from mjlab.envs import ManagerBasedRlEnv
        from mjlab.managers.scene_entity_config import SceneEntityCfg


        def upright(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> torch.Tensor:
            asset: Entity = env.scene[asset_cfg.name]
            return torch.cos(asset.data.joint_pos[:, asset_cfg.joint_ids]).squeeze(-1)
    """,
    "old_style/tasks/env_cfg.py": """
        import mujoco

        from mjlab.actuator import XmlMotorActuatorCfg
        from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
        from mjlab.envs import ManagerBasedRlEnvCfg
        from mjlab.envs.mdp.actions import JointEffortActionCfg
        from mjlab.managers.event_manager import EventTermCfg
        from mjlab.managers.observation_manager import ObservationGroupCfg, ObservationTermCfg
        from mjlab.managers.reward_manager import RewardTermCfg
        from mjlab.managers.scene_entity_config import SceneEntityCfg
        from mjlab.managers.termination_manager import TerminationTermCfg
        from mjlab.rl import RslRlModelCfg, RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg
        from mjlab.scene import SceneCfg
        from mjlab.sim import MujocoCfg, SimulationCfg
        from mjlab.terrains import TerrainImporterCfg
        from mjlab.utils.noise import UniformNoiseCfg as Unoise

        from old_style import mdp

        XML = '''
        <mujoco>
          <worldbody>
            <body name="cart">
              <joint name="slider" type="slide" axis="1 0 0"/>
              <geom name="cart" type="box" size=".2 .1 .1" mass="1"/>
              <body name="pole">
                <joint name="hinge" axis="0 1 0"/>
                <geom name="pole" type="capsule" fromto="0 0 0 0 0 1" size=".04" mass=".1"/>
              </body>
            </body>
          </worldbody>
          <actuator><motor name="slide" joint="slider"/></actuator>
        </mujoco>
        '''


        def env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
            joints = SceneEntityCfg("robot", joint_names=(".*",))
            terms = {
                "pos": ObservationTermCfg(
                    func=mdp.joint_pos_rel,
                    params={"asset_cfg": joints},
                    noise=Unoise(n_min=-0.01, n_max=0.01),
                ),
                "vel": ObservationTermCfg(func=mdp.joint_vel_rel, params={"asset_cfg": joints}),
                "last": ObservationTermCfg(func=mdp.last_action),
            }
            return ManagerBasedRlEnvCfg(
                decimation=2,
                episode_length_s=1e9 if play else 1.0,
                scene=SceneCfg(
                    num_envs=4,
                    terrain=TerrainImporterCfg(terrain_type="plane"),
                    entities={
                        "robot": EntityCfg(
                            spec_fn=lambda: mujoco.MjSpec.from_string(XML),
                            articulation=EntityArticulationInfoCfg(
                                actuators=(XmlMotorActuatorCfg(target_names_expr=("slider",)),)
                            ),
                        )
                    },
                ),
                observations={
                    "actor": ObservationGroupCfg(terms=terms, enable_corruption=not play),
                    "critic": ObservationGroupCfg(terms={**terms}),
                },
                actions={
                    "effort": JointEffortActionCfg(
                        entity_name="robot", actuator_names=("slider",)
                    )
                },
                events={
                    "reset": EventTermCfg(func=mdp.reset_scene_to_default, mode="reset"),
                    "mass": EventTermCfg(
                        func=mdp.randomize_field,
                        mode="startup",
                        domain_randomization=True,
                        params={
                            "asset_cfg": SceneEntityCfg("robot", body_names=("pole",)),
                            "field": "body_mass",
                            "operation": "scale",
                            "ranges": (0.5, 2.0),
                        },
                    ),
                    "friction": EventTermCfg(
                        func=mdp.randomize_field,
                        mode="startup",
                        domain_randomization=True,
                        params={
                            "asset_cfg": SceneEntityCfg("robot", geom_names=(".*",)),
                            "field": "geom_friction",
                            "operation": "abs",
                            "ranges": (0.3, 1.2),
                        },
                    ),
                },
                rewards={
                    "upright": RewardTermCfg(
                        func=mdp.upright,
                        weight=1.0,
                        params={"asset_cfg": SceneEntityCfg("robot", joint_names=("hinge",))},
                    )
                },
                terminations={"time_out": TerminationTermCfg(func=mdp.time_out, time_out=True)},
                sim=SimulationCfg(mujoco=MujocoCfg(timestep=0.01, multiccd=True)),
            )


        def rl_cfg() -> RslRlOnPolicyRunnerCfg:
            return RslRlOnPolicyRunnerCfg(
                actor=RslRlModelCfg(hidden_dims=(8,), stochastic=True, init_noise_std=0.5),
                critic=RslRlModelCfg(hidden_dims=(8,), stochastic=False),
                algorithm=RslRlPpoAlgorithmCfg(),
                experiment_name="old_style",
                num_steps_per_env=4,
                max_iterations=1,
            )
    """,
}


@pytest.fixture
def old_style(install) -> list[str]:
    """Install a package written for release 1.1; return the warnings."""
    install("old-style", {"old_style": "old_style.tasks"}, OLD_STYLE)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert "Old-Style-Cartpole" in registry.list_tasks()
    return [str(one.message) for one in caught if one.category is FutureWarning]


def test_each_older_spelling_of_a_package_warns_once_with_todays(old_style):
    # Functions warn when they are called, so `randomize_field` is not among these.
    for older, today in [
        ("XmlMotorActuatorCfg", "XmlActuatorCfg"),
        ("TerrainImporterCfg", "TerrainEntityCfg"),
        ("EventTermCfg.domain_randomization", "nothing"),
        ("RslRlModelCfg.stochastic", "distribution_cfg"),
        ("RslRlModelCfg.init_noise_std", "distribution_cfg"),
        ("MujocoCfg.multiccd", "disableflags"),
    ]:
        about = [text for text in old_style if older in text]
        assert about
        assert all(today in text for text in about)
        assert len(about) == len(set(about))


def test_a_package_written_for_release_1_1_builds_and_steps(old_style):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = ManagerBasedRlEnv(registry.load_env_cfg("Old-Style-Cartpole"), device="cpu")
    env.reset()
    for _ in range(5):
        observations, reward, *_ = env.step(torch.rand(4, 1))
    assert observations["actor"].shape == (4, 5)
    assert torch.isfinite(reward).all()
    pole = env.sim.mj_model.body("robot/pole").id
    mass = env.sim.model.body_mass[:, pole]
    assert len(mass.unique()) == 4
    assert ((mass >= 0.05) & (mass <= 0.2)).all()
    friction = env.sim.model.geom_friction[:, env.sim.mj_model.geom("robot/pole").id, 0]
    assert len(friction.unique()) == 4
    env.close()


def test_a_package_written_for_release_1_1_trains(old_style, tmp_path):
    from mjlab.scripts.train import TrainConfig, launch_training

    cfg = TrainConfig.from_task("Old-Style-Cartpole")
    cfg.device, cfg.log_root = "cpu", str(tmp_path / "logs")
    assert cfg.agent.actor.distribution_cfg["init_std"] == 0.5  # ty: ignore
    assert cfg.agent.critic.distribution_cfg is None  # ty: ignore
    threads = torch.get_num_threads()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run_dir: Path = launch_training("Old-Style-Cartpole", cfg)
    torch.set_num_threads(threads)
    assert (run_dir / "model_0.pt").is_file()
