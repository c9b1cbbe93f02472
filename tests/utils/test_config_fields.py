"""Attributes of configs that are not fields."""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass, field

import pytest

from mjlab.entity import EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg, mdp
from mjlab.managers import ObservationGroupCfg, ObservationTermCfg, RewardTermCfg
from mjlab.rl import RslRlOnPolicyRunnerCfg
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
def test_a_misspelled_field_stops_the_build_and_names_the_field(part, name, field):
    cfg = make_cfg()
    setattr(part(cfg), name, 3)
    with pytest.raises(ValueError, match=rf"{name}: \w+ has no such field.*{field!r}"):
        ManagerBasedRlEnv(cfg, device="cpu")


def test_a_misspelled_field_of_the_agent_config_is_an_error():
    cfg = RslRlOnPolicyRunnerCfg()
    cfg.algorithm.learning_rates = 1e-4  # ty: ignore
    with pytest.raises(ValueError, match=r"algorithm\.learning_rates.*'learning_rate'"):
        check_fields_exist("agent", cfg)


def test_other_attributes_are_reported_in_one_warning_once():
    cfg = make_cfg()
    cfg.curriculum_phase_of_a_package, cfg.sim.dt = 3, 0.005  # ty: ignore
    with pytest.warns(UserWarning, match="not fields") as seen:
        check_fields_exist("cfg", cfg)
        check_fields_exist("cfg", cfg)
    assert len(seen) == 1
    assert "cfg.curriculum_phase_of_a_package" in str(seen[0].message)
    assert "cfg.sim.dt (SimulationCfg)" in str(seen[0].message)


def test_a_numbered_attribute_is_not_misspelled():
    cfg = make_cfg()
    cfg.seed2 = 3  # ty: ignore
    with pytest.warns(UserWarning, match=r"cfg\.seed2"):
        check_fields_exist("cfg", cfg)


@dataclass
class OwnCfg(SceneCfg):
    """Config of a package that keeps values of its own."""

    motion_file: str = ""
    shared = None

    def __post_init__(self) -> None:
        self.motion_files = [self.motion_file]
        setattr(self, "sensor", None)  # noqa: B010
        self._num_env = 1


@dataclass
class Unrelated:
    values: list[int] = field(default_factory=list)


def test_attributes_that_the_class_or_its_methods_name_are_allowed():
    cfg = make_cfg()
    cfg.scene = OwnCfg()
    cfg.scene.shared = 2
    own = Unrelated()
    own.value = 1  # ty: ignore
    cfg.rewards["alive"].params["own"] = own
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_fields_exist("cfg", cfg)
        check_fields_exist("cfg", dataclasses.replace(cfg))


@dataclass
class MisspelledCfg(SceneCfg):
    def __post_init__(self) -> None:
        self.env_spacign = 3.0


def test_a_field_misspelled_in_a_method_of_its_class_is_an_error():
    cfg = make_cfg()
    cfg.scene = MisspelledCfg()
    with pytest.raises(ValueError, match=r"cfg\.scene\.env_spacign.*'env_spacing'"):
        check_fields_exist("cfg", cfg)


@pytest.mark.parametrize("name", ["my_events", "commands_cfg", "max_episode_length_s"])
def test_names_with_a_further_word_are_attributes_of_packages(name):
    cfg = make_cfg()
    setattr(cfg, name, 1)
    with pytest.warns(UserWarning, match=name):
        check_fields_exist("cfg", cfg)


@pytest.mark.parametrize("task", list_tasks())
def test_registered_tasks_are_silent(task):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for play in (False, True):
            check_fields_exist("env", load_env_cfg(task, play=play))
        check_fields_exist("agent", load_rl_cfg(task))


def test_a_legacy_flag_set_as_an_attribute_is_no_misspelled_field():
    term = RewardTermCfg(func=mdp.is_alive, weight=1.0)
    term.domain_randomization = True  # ty: ignore
    with pytest.warns(UserWarning, match="domain_randomization"):
        check_fields_exist("term", term)
