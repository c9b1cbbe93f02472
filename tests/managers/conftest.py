"""A small stand-in for the environment, so that managers are tested without physics."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from mjlab.utils.lab_api.string import resolve_matching_names

_KINDS = {
    "joint": "joints",
    "body": "bodies",
    "geom": "geoms",
    "site": "sites",
    "actuator": "actuators",
    "tendon": "tendons",
    "camera": "cameras",
    "light": "lights",
    "material": "materials",
    "texture": "textures",
    "pair": "pairs",
}


class FakeEntity:
    """Has names of every kind, and finds them as an entity does."""

    def __init__(self) -> None:
        for kind, plural in _KINDS.items():
            names = tuple(f"{kind}_{letter}" for letter in "abc")
            setattr(self, f"{kind}_names", names)
            setattr(self, f"find_{plural}", self._finder(f"{kind}_names"))

    def _finder(self, attribute: str) -> Any:
        def find(name_keys: Any, preserve_order: bool = False) -> Any:
            return resolve_matching_names(name_keys, getattr(self, attribute), preserve_order)

        return find


class FakeScene(dict):
    """A dict that says what it holds."""

    def __missing__(self, key: str) -> Any:
        raise KeyError(f"No {key!r} in the scene; it holds {list(self)}.")


class FakeSim:
    """Records the levels of recomputed constants."""

    def __init__(self) -> None:
        self.recomputed: list[int] = []
        self.recomputed_for: list[Any] = []

    def recompute_constants(self, level: int, env_ids: Any = None) -> None:
        self.recomputed.append(level)
        self.recomputed_for.append(env_ids)


class FakeEnv:
    """The attributes of an environment that managers read, and `value`, which terms may return."""

    def __init__(self, num_envs: int = 4) -> None:
        self.num_envs = num_envs
        self.device = "cpu"
        self.step_dt = 0.02
        self.max_episode_length_s = 10.0
        self.scene = FakeScene(robot=FakeEntity(), camera=SimpleNamespace())
        self.sim = FakeSim()
        self.extras: dict[str, Any] = {}
        self.value = torch.zeros(num_envs)
        self.diverged = torch.zeros(num_envs, dtype=torch.bool)
        self.common_step_counter = 0


@pytest.fixture
def env() -> FakeEnv:
    torch.manual_seed(0)
    return FakeEnv()


@pytest.fixture(scope="session")
def make_env() -> type[FakeEnv]:
    return FakeEnv
