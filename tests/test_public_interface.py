"""The public names, signatures, fields and defaults are those of the interface of 1.6."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import inspect
import sys
import warnings
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from public_interface import (
    Entry,
    command_line,
    config_kinds,
    entries,
    is_offered,
    older_entries,
    problems,
    resolve,
)

# What differs on purpose.
DEVIATIONS = {
    # Private: how the group finds its actuators.
    "mjlab.actuator.builtin_group.BuiltinActuatorGroup": {"field _index_groups is missing"},
    # Private, and a config is not a cache.
    "mjlab.utils.noise.noise_cfg.NoiseCfg": {"field _tensor_cache is missing"},
    # Nothing leaves the machine unless it is asked for.
    "mjlab.rl.config.RslRlBaseRunnerCfg": {
        "field logger has the default 'tensorboard', not 'wandb'"
    },
}

# Flags of 1.6 that are not there: the reason is said once for each.
MISSING_FLAGS = {
    "mjlab.scripts.train.TrainConfig": {
        # Of motion tracking, which brings it itself: see `mjlab.tasks.registry`.
        "registry_name",
    },
    "mjlab.scripts.play.PlayConfig": {
        # Of motion tracking, which brings them itself, and of the demo.
        "registry_name",
        "motion_file",
        "_demo_mode",
    },
}

ENTRIES = entries()


def test_the_list_was_read_in_full():
    assert len(ENTRIES) > 590
    assert len({entry.module for entry in ENTRIES}) > 120
    assert sum(len(entry.members) for entry in ENTRIES) > 1400


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.path)
def test_a_name_is_as_the_interface_has_it(entry):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        found = set(problems(entry))
    expected = DEVIATIONS.get(entry.path, set())
    assert found == expected


def test_the_list_of_earlier_names_was_read_in_full():
    assert len(older_entries()) > 110


@pytest.mark.filterwarnings("ignore::FutureWarning")
@pytest.mark.parametrize("entry", older_entries(), ids=lambda entry: entry.path)
def test_a_name_of_an_earlier_release_is_there(entry):
    assert is_offered(entry)


CONFIG_KINDS = config_kinds()
# Here the function comes first, as in other terms; 1.6.0 has it as a keyword behind `params`.
MORE_LENIENT = {"mjlab.managers.reward_manager.RewardTermCfg"}


def test_the_constructors_of_all_configs_were_read():
    assert len(CONFIG_KINDS) > 100
    assert sum(not positional for positional, _ in CONFIG_KINDS.values()) > 30


@pytest.mark.parametrize("path", CONFIG_KINDS)
def test_a_config_takes_the_same_arguments_by_position_and_by_keyword(path):
    positional, keyword_only = CONFIG_KINDS[path]
    parameters = inspect.signature(resolve(path)).parameters
    found = [name for name, p in parameters.items() if p.kind is p.POSITIONAL_OR_KEYWORD]
    assert set(positional + keyword_only) <= set(parameters)
    if path in MORE_LENIENT:
        assert found[0] == "func"
        return
    assert found[: len(positional)] == positional
    assert not set(keyword_only) & set(found)
    if not positional:
        assert not found


@pytest.mark.parametrize("path", command_line())
def test_the_fields_of_a_command_line_are_there(path):
    module, _, name = path.rpartition(".")
    config = getattr(importlib.import_module(module), name)
    missing = set(command_line()[path]) - {field.name for field in dataclasses.fields(config)}
    assert missing == MISSING_FLAGS[path]


@pytest.mark.parametrize(
    ("module", "line", "members", "problem"),
    [
        ("mjlab.entity", "exports: Entity, Nothing", (), "Nothing is not exported"),
        ("mjlab.tasks.registry", "def no_such_function() -> None", (), "is missing"),
        ("mjlab.tasks.registry", "def list_tasks(name: str) -> None", (), "parameter name is missing"),
        (
            "mjlab.tasks.registry",
            "def load_env_cfg(play: bool = False, task_name: str = '') -> None",
            (),
            "parameter play is number 1, not 0",
        ),
        (
            "mjlab.tasks.registry",
            "def load_env_cfg(task_name: str, play: bool = True) -> None",
            (),
            "parameter play has the default False, not True",
        ),
        ("mjlab.tasks.registry", "def load_env_cfg() -> None", (), "parameter task_name is required and not in the list"),
        ("mjlab.sim", "class SimulationCfg(Entity)  [dataclass]", (), "does not derive from Entity"),
        ("mjlab.sim", "class SimulationCfg()  [dataclass]", ("x: int",), "field x is missing"),
        (
            "mjlab.sim",
            "class MujocoCfg()  [dataclass]",
            ("timestep: float = 0.003",),
            "field timestep has the default 0.002, not 0.003",
        ),
        (
            "mjlab.sim",
            "class MujocoCfg()  [dataclass]",
            ("integrator: str", "timestep: float"),
            "field timestep comes too early",
        ),
        ("mjlab.envs", "class ManagerBasedRlEnv()", ("gone(self) -> None",), "method gone is missing"),
        (
            "mjlab.envs",
            "class ManagerBasedRlEnv()",
            ("step(self, act: Tensor) -> None",),
            "step: parameter act is missing",
        ),
        ("mjlab.envs", "class ManagerBasedRlEnv()", ("@property gone -> int",), "property gone is missing"),
        ("mjlab.envs", "class ManagerBasedRlEnv()", ("@property step -> int",), "property step is a method"),
        ("mjlab", "MJLAB_SRC_PATH: dict", (), "is of type PosixPath, not dict"),
        (
            "mjlab.asset_zoo.robots",
            "YAM_ACTION_SCALE: dict of 3: joint1, joint2, joint4",
            (),
            "has 7 elements, not 3",
        ),
        (
            "mjlab.asset_zoo.robots",
            "YAM_ACTION_SCALE: dict of 7: joint2, joint1",
            (),
            "starts with ['joint1', 'joint2'], not ['joint2', 'joint1']",
        ),
        (
            "mjlab.managers",
            "EventMode = Literal['startup', 'reset']  [type alias]",
            (),
            "allows ['startup', 'reset', 'interval', 'step'], not ['startup', 'reset']",
        ),
        (
            "mjlab.envs.mdp.events",
            "class apply_body_impulse()",
            ("class VizCfg(scale, rgba)",),
            "VizCfg: has fields ['rgba', 'scale', 'width', 'min_force'], not ['scale', 'rgba']",
        ),
        ("mjlab.entity", "class EntityData()", ("POS_DIM = 4",), "POS_DIM is 3, not 4"),
        ("mjlab.actuator.actuator", "class TransmissionType(str)", ("JOINT = 'x'",), "JOINT is 'joint', not 'x'"),
    ],
)  # fmt: skip
def test_the_comparison_sees(module, line, members, problem):
    from public_interface import _name

    assert problem in problems(Entry(module, _name(line), line, members))
