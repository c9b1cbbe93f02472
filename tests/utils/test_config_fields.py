"""Attributes of configs that are not fields."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field

import pytest

from mjlab.entity import EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers import ObservationGroupCfg, ObservationTermCfg, RewardTermCfg
from mjlab.scene import SceneCfg
from mjlab.tasks.registry import list_tasks, load_env_cfg, load_rl_cfg
from mjlab.utils.config_fields import check_fields_exist


def make_cfg() -> ManagerBasedRlEnvCfg:
    return ManagerBasedRlEnvCfg(
        decimation=1,
        scene=SceneCfg(entities={"robot": EntityCfg()}),
        observations={"actor": ObservationGroupCfg(terms={"q": ObservationTermCfg(func=len)})},
        rewards={"alive": RewardTermCfg(func=len, weight=1.0)},
    )


@pytest.mark.parametrize(
    ("part", "name", "field"),
    [
        (lambda cfg: cfg, "episode_lenght_s", "episode_length_s"),
        (lambda cfg: cfg, "reward", "rewards"),
        (lambda cfg: cfg.scene, "num_env", "num_envs"),
        (lambda cfg: cfg.sim.mujoco, "timstep", "timestep"),
        (lambda cfg: cfg.rewards["alive"], "wieght", "weight"),
        (lambda cfg: cfg.observations["actor"], "enable_coruption", "enable_corruption"),
        (lambda cfg: cfg.observations["actor"].terms["q"], "scales", "scale"),
        (lambda cfg: cfg.scene.entities["robot"].init_state, "join_pos", "joint_pos"),
    ],
)
def test_a_misspelled_field_is_reported_with_the_field(part, name, field):
    cfg = make_cfg()
    setattr(part(cfg), name, 3)
    with pytest.warns(UserWarning, match=rf"{name}.*{field!r}"):
        check_fields_exist(name, cfg)


def test_an_environment_builds_with_attributes_of_a_package():
    cfg = load_env_cfg("Mjlab-Cartpole-Balance")
    cfg.scene.num_envs = 1
    cfg.episode_lenght_s, cfg.curriculum_phase = 3.0, 2  # ty: ignore
    with pytest.warns(UserWarning, match=r"lenght_s.*'episode_length_s'.*curriculum_phase") as seen:
        ManagerBasedRlEnv(cfg, device="cpu").close()
    assert sum("not fields" in str(w.message) for w in seen) == 1


def test_attributes_are_reported_in_one_warning_once():
    cfg = make_cfg()
    cfg.curriculum_phase_of_a_package, cfg.sim.dt = 3, 0.005  # ty: ignore
    with pytest.warns(UserWarning, match="not fields") as seen:
        check_fields_exist("cfg", cfg)
        check_fields_exist("cfg", cfg)
    assert len(seen) == 1
    assert "cfg.curriculum_phase_of_a_package" in str(seen[0].message)
    assert "cfg.sim.dt" in str(seen[0].message)


@dataclass
class OwnCfg(SceneCfg):
    """Config of a package that keeps values of its own."""

    motion_file: str = ""
    shared = None

    def __post_init__(self) -> None:
        self.motion_files = [self.motion_file]
        self._num_env = 1


@dataclass
class Unrelated:
    values: list[int] = field(default_factory=list)


def test_only_public_attributes_of_our_configs_count():
    cfg = make_cfg()
    cfg.scene = OwnCfg()
    cfg.scene.shared = 2
    own = Unrelated()
    own.value = 1  # ty: ignore
    cfg.rewards["alive"].params["own"] = own
    with pytest.warns(UserWarning, match="not fields") as seen:
        check_fields_exist("own", cfg)
    text = str(seen[0].message)
    assert "own.scene.motion_files" in text
    assert not any(name in text for name in ("shared", "_num_env", "value"))


@pytest.mark.parametrize("task", list_tasks())
def test_registered_tasks_are_silent(task):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for play in (False, True):
            check_fields_exist("env", load_env_cfg(task, play=play))
        check_fields_exist("agent", load_rl_cfg(task))
