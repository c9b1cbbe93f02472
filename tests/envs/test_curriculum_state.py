"""Curriculum state, restored in other numbers of environments and in changed tasks."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.envs.curriculum_state import lasting_state
from mjlab.managers import (
    CommandTerm,
    CommandTermCfg,
    CurriculumTermCfg,
    EventTermCfg,
    ManagerTermBase,
    RewardTermCfg,
    TerminationTermCfg,
)
from mjlab.rl.checkpoint import load_checkpoint, save_checkpoint
from mjlab.tasks.registry import load_env_cfg
from mjlab.terrains import TerrainEntityCfg, TerrainGeneratorCfg
from mjlab.terrains.primitive_terrains import BoxFlatTerrainCfg
from mjlab.utils.noise import UniformNoiseCfg


class Target(CommandTerm):
    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        self.target = torch.zeros(env.num_envs, 1)
        self.scale = 0.5
        self.hardness = torch.zeros(env.num_envs)

    @property
    def command(self) -> torch.Tensor:
        return self.target

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        self.target[env_ids] = torch.empty(len(env_ids), 1).uniform_(*self.cfg.ranges.x)


@dataclass
class Ranges:
    x: tuple[float, float] = (0.0, 0.1)


@dataclass(kw_only=True)
class TargetCfg(CommandTermCfg):
    ranges: Ranges = field(default_factory=Ranges)

    def build(self, env: Any) -> Target:
        return Target(self, env)


def too_far(env: Any, limit: float) -> torch.Tensor:
    return torch.zeros(env.num_envs, dtype=torch.bool)


def count_in_env(env: Any, env_ids: Any, by: float = 1.0) -> float:
    env.stage = getattr(env, "stage", 0.0) + by
    return env.stage


def drift(env: Any, env_ids: Any, size: float, gains: torch.Tensor) -> None:
    """Do nothing; a curriculum edits its parameters."""


class Hardens(ManagerTermBase):
    """A curriculum that keeps its memory in all places."""

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(env)
        self.speed = cfg.params["speed"]
        self.successes: deque[float] = deque(maxlen=3)
        self.bins = torch.zeros(3)
        self.levels = torch.zeros(env.num_envs)

    def __call__(self, env: Any, env_ids: Any, speed: float) -> float:
        self.successes.append(float(len(self.successes)))
        self.bins += 1.0
        self.levels[env_ids] += torch.arange(env.num_envs)[env_ids]
        command = env.command_manager.get_term("target")
        command.cfg.ranges.x = (0.0, command.cfg.ranges.x[1] + 1.0)
        command.scale += 0.5
        command.hardness[env_ids] += torch.arange(env.num_envs)[env_ids]
        env.reward_manager.get_term_cfg("smooth_reward").weight += 1.0
        env.termination_manager.get_term_cfg("too_far").params["limit"] += 1.0
        event = env.event_manager.get_term_cfg("drift").params
        event["size"] += 1.0
        event["gains"] = event["gains"] + 1.0
        env.observation_manager.get_term_cfg("actor", "cart_pos").noise.n_max += 1.0
        env.cfg.episode_length_s += 0.05
        return command.scale


def task(num_envs: int, speed: float = 2.0) -> Any:
    cfg = load_env_cfg("Mjlab-Cartpole-Balance")
    cfg.scene.num_envs, cfg.seed, cfg.episode_length_s = num_envs, 1, 0.2
    cfg.sim.num_threads, cfg.sim.engine = 1, "native"
    cfg.commands["target"] = TargetCfg(resampling_time_range=(9.0, 9.0))
    cfg.terminations["too_far"] = TerminationTermCfg(func=too_far, params={"limit": 1.0})
    params = {"size": 0.0, "gains": torch.zeros(2)}
    cfg.events["drift"] = EventTermCfg(func=drift, mode="reset", params=params)
    cfg.observations["actor"].terms["cart_pos"].noise = UniformNoiseCfg(n_min=0.0, n_max=0.1)
    cfg.curriculum["hardens"] = CurriculumTermCfg(func=Hardens, params={"speed": speed})
    cfg.curriculum["counts"] = CurriculumTermCfg(func=count_in_env)
    return cfg


def memory(env: ManagerBasedRlEnv) -> dict[str, Any]:
    """Return what does not depend on the number of environments."""
    term = env.curriculum_manager.get_term_cfg("hardens").func
    command: Any = env.command_manager.get_term("target")
    event = env.event_manager.get_term_cfg("drift").params
    noise: Any = env.observation_manager.get_term_cfg("actor", "cart_pos").noise
    return {
        "successes": list(term.successes),
        "bins": term.bins.tolist(),
        "range": command.cfg.ranges.x,
        "scale": command.scale,
        "weight": env.reward_manager.get_term_cfg("smooth_reward").weight,
        "limit": env.termination_manager.get_term_cfg("too_far").params["limit"],
        "size": event["size"],
        "gains": event["gains"].tolist(),
        "noise": noise.n_max,
        "episode": env.max_episode_length,
        "stage": env.stage,  # ty: ignore[missing-attribute]
        "steps": env.common_step_counter,
        "logged": dict(env.curriculum_manager.get_active_iterable_terms(0)),
    }


@pytest.fixture
def make() -> Iterator[Callable[..., Any]]:
    envs: list[ManagerBasedRlEnv] = []

    def build(num_envs: int, edit: Callable[[Any], None] = lambda _: None, **kwargs: Any) -> Any:
        cfg = task(num_envs, **kwargs)
        edit(cfg)
        envs.append(ManagerBasedRlEnv(cfg, device="cpu"))
        envs[-1].reset()
        return envs[-1]

    yield build
    for env in envs:
        env.close()


def trained(make: Callable[..., Any], num_envs: int, **kwargs: Any) -> Any:
    env = make(num_envs, **kwargs)
    for _ in range(15):
        env.step(torch.zeros(num_envs, 1))
    return env


def hardened(env: Any) -> torch.Tensor:
    return env.curriculum_manager.get_term_cfg("hardens").func.levels


@pytest.mark.parametrize(("before", "after"), [(4, 4), (4, 6), (6, 4), (1, 3), (3, 1), (2, 2)])
def test_memory_of_all_kinds_continues(make, tmp_path, before, after):
    env = trained(make, before)
    # Through a file, as in a resume.
    save_checkpoint({"state": env.curriculum_state()}, tmp_path / "state.pt")
    other = make(after)
    assert memory(other) != memory(env)
    assert other.load_curriculum_state(load_checkpoint(tmp_path / "state.pt")["state"]) == []
    assert memory(other) == memory(env)
    rows = torch.arange(after) * before // after
    assert torch.equal(hardened(other), hardened(env)[rows])
    terms = [one.command_manager.get_term("target").hardness for one in (env, other)]
    assert torch.equal(terms[1], terms[0][rows])


def test_held_curricula_do_not_move(make):
    env = trained(make, 3)
    before = memory(env)
    with env.curriculum_manager.held():
        env.reset()
        for _ in range(15):
            env.step(torch.zeros(3, 1))
    after = memory(env)
    assert after.pop("steps") == before.pop("steps") + 15
    assert after == before
    env.reset()
    assert memory(env)["scale"] == before["scale"] + 0.5


def test_an_exact_state_holds_attributes_and_settings(make):
    env, other = trained(make, 3), make(3)
    other.load_state_dict(env.state_dict())
    assert memory(other) == memory(env)


def test_attributes_of_environments_are_no_memory():
    cfg = load_env_cfg("Mjlab-Cartpole-Balance")
    cfg.scene.num_envs = 2
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    env.step(torch.zeros(2, 1))
    assert lasting_state(env)["attributes"] == {}
    env.close()


def test_settings_of_the_new_config_are_kept(make):
    other = make(4, speed=5.0)
    other.load_curriculum_state(trained(make, 2, speed=2.0).curriculum_state())
    assert other.curriculum_manager.get_term_cfg("hardens").func.speed == 5.0


def test_terms_that_are_gone_are_named(make):
    env = trained(make, 4)

    def edit(cfg: Any) -> None:
        cfg.rewards = {"alive": RewardTermCfg(func=lambda e: torch.ones(e.num_envs), weight=1.0)}
        cfg.curriculum = {"counts": CurriculumTermCfg(func=count_in_env)}

    other = make(6, edit)
    left_out = other.load_curriculum_state(env.curriculum_state())
    assert any("smooth_reward" in name for name in left_out)
    assert any("hardens" in name for name in left_out)
    assert other.stage == env.stage
    assert other.reward_manager.get_term_cfg("alive").weight == 1.0
    other.reset()
    assert "Curriculum/hardens" not in other.extras["log"]


def eases(env: Any, env_ids: Any) -> None:
    """Reduce pushes and noise, and the range that `stages` sets."""
    env.event_manager.get_term_cfg("drift").params["size"] = 0.5
    env.command_manager.get_term("target").scale = 0.1
    ranges = env.command_manager.get_term_cfg("target").ranges
    ranges.x = (ranges.x[0] / 2.0, ranges.x[1] / 2.0)


def stages(env: Any, env_ids: Any) -> None:
    far = env.common_step_counter >= 10
    env.command_manager.get_term_cfg("target").ranges.x = (0.0, 3.0 if far else 2.0)


def grows(env: Any, env_ids: Any) -> None:
    env.reward_manager.get_term_cfg("smooth_reward").weight += 1.0


def test_edits_of_a_term_that_is_gone_are_undone(make):
    terms = {"stages": stages, "grows": grows}

    def edit(cfg: Any, **more: Any) -> None:
        every = {**terms, **more}
        cfg.curriculum = {name: CurriculumTermCfg(func=func) for name, func in every.items()}

    env = trained(make, 4, edit=lambda cfg: edit(cfg, eases=eases))
    command: Any = env.command_manager.get_term("target")
    assert (command.cfg.ranges.x, command.scale) == ((0.0, 1.5), 0.1)
    other = make(6, edit)
    assert other.load_curriculum_state(env.curriculum_state()) == ["curriculum_manager.eases"]
    command = other.command_manager.get_term("target")
    # The range as of the stage, the weight as of its curriculum, the rest as configured.
    assert (command.cfg.ranges.x, command.scale) == ((0.0, 3.0), 0.5)
    assert other.event_manager.get_term_cfg("drift").params["size"] == 0.0
    weight = env.reward_manager.get_term_cfg("smooth_reward").weight
    assert weight > 4.0
    assert other.reward_manager.get_term_cfg("smooth_reward").weight == weight


def replaces(env: Any, env_ids: Any) -> None:
    command: Any = env.command_manager.get_term("target")
    x = command.cfg.ranges.x[1] + 1.0
    command.cfg = dataclasses.replace(command.cfg, ranges=Ranges(x=(0.0, x)))


def test_replaced_configs_continue(make):
    def edit(cfg: Any) -> None:
        cfg.curriculum = {"replaces": CurriculumTermCfg(func=replaces)}

    env, same, other = trained(make, 4, edit=edit), make(4, edit), make(6, edit)
    x = env.command_manager.get_term_cfg("target").ranges.x
    assert x[1] > 3.0
    same.load_state_dict(env.state_dict())
    assert other.load_curriculum_state(env.curriculum_state()) == []
    for one in (same, other):
        assert one.command_manager.get_term_cfg("target").ranges.x == x


@pytest.mark.parametrize("same_number", [True, False])
def test_values_set_by_the_new_config_are_kept(make, same_number):
    env = trained(make, 4)

    def edit(cfg: Any) -> None:
        cfg.rewards["smooth_reward"].weight = 40.0
        cfg.commands["target"].ranges.x = (-7.0, 7.0)

    other = make(4 if same_number else 6, edit)
    state = env.state_dict()
    with pytest.raises(
        ValueError, match="smooth_reward.weight 40.0" if same_number else "--num-envs"
    ):
        other.load_state_dict(state)
    left_out = other.load_curriculum_state(state["curriculum"])
    assert "reward_manager.smooth_reward.weight" in left_out
    assert other.reward_manager.get_term_cfg("smooth_reward").weight == 40.0
    assert other.command_manager.get_term_cfg("target").ranges.x == (-7.0, 7.0)
    size = env.event_manager.get_term_cfg("drift").params["size"]
    assert other.event_manager.get_term_cfg("drift").params["size"] == size


def test_parameters_of_another_function_are_named(make):
    def limited(env: Any, radius: float) -> torch.Tensor:
        return torch.zeros(env.num_envs, dtype=torch.bool)

    def edit(cfg: Any) -> None:
        cfg.terminations["too_far"] = TerminationTermCfg(func=limited, params={"radius": 1.0})
        cfg.curriculum = {"hardens": CurriculumTermCfg(func=count_in_env)}

    other = make(6, edit)
    left_out = other.load_curriculum_state(trained(make, 4).curriculum_state())
    assert any("too_far.params.limit" in name for name in left_out)
    other.step(torch.zeros(6, 1))


def test_a_parameter_added_by_a_curriculum_continues(make):
    env, other = trained(make, 2), make(3)
    env.curriculum_manager.get_term_cfg("counts").params["by"] = 3.0
    assert other.load_curriculum_state(env.curriculum_state()) == []
    stage = other.stage
    other.reset()
    assert other.stage == stage + 3.0


def test_tables_of_another_size_are_named(make):
    env, other = trained(make, 2), make(3)
    term = env.curriculum_manager.get_term_cfg("hardens").func
    term.bins = torch.ones(7)
    left_out = other.load_curriculum_state(env.curriculum_state())
    assert [name for name in left_out if "bins" in name]
    assert other.curriculum_manager.get_term_cfg("hardens").func.bins.shape == (3,)


def test_a_new_environment_has_no_memory(make):
    """Attributes of the environment itself are not taken for memory of curricula."""
    env = make(2, lambda cfg: cfg.curriculum.clear())
    for _ in range(15):
        env.step(torch.zeros(2, 1))
    changed = env.curriculum_state()["changed"]
    assert not changed.get("attributes")
    assert not changed.get("settings")


def on_terrain(num_rows: int) -> Callable[[Any], None]:
    def edit(cfg: Any) -> None:
        cfg.scene.terrain = TerrainEntityCfg(
            terrain_type="generator",
            terrain_generator=TerrainGeneratorCfg(
                size=(2.0, 2.0), num_rows=num_rows, num_cols=2, curriculum=True, border_width=0.0,
                sub_terrains={"a": BoxFlatTerrainCfg(), "b": BoxFlatTerrainCfg()},
            ),
            max_init_terrain_level=0,
        )  # fmt: skip

    return edit


def test_terrain_levels_are_spread(make):
    env = make(4, on_terrain(5))
    env.scene.terrain.set_levels(torch.tensor([0, 1, 3, 4]))
    other = make(8, on_terrain(5))
    assert other.load_curriculum_state(env.curriculum_state()) == []
    terrain = other.scene.terrain
    assert terrain.terrain_levels.tolist() == [0, 0, 1, 1, 3, 3, 4, 4]
    expected = terrain.terrain_origins[terrain.terrain_levels, terrain.terrain_types]
    assert torch.equal(terrain.env_origins, expected)


@pytest.mark.parametrize("edit", [on_terrain(3), lambda cfg: None])
def test_levels_of_another_terrain_are_named(make, edit):
    state = make(4, on_terrain(5)).curriculum_state()
    assert "terrain levels" in make(4, edit).load_curriculum_state(state)
