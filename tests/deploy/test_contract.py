"""Configs that a contract cannot describe."""

from __future__ import annotations

import copy
from typing import Any

import pytest
from bundles import write_random


def test_terms_of_two_groups_with_one_name(tmp_path):
    def edit(env: Any, agent: Any) -> None:
        env.observations["extra"] = copy.deepcopy(env.observations["actor"])
        agent.obs_groups = {**agent.obs_groups, "actor": ("actor", "extra")}

    with pytest.raises(ValueError, match="groups actor, extra"):
        write_random("Mjlab-Cartpole-Swingup", tmp_path / "bundle", edit)


def test_actions_of_two_entities(tmp_path):
    def edit(env: Any, agent: Any) -> None:
        env.scene.entities["second"] = copy.deepcopy(env.scene.entities["cartpole"])
        env.actions["other"] = copy.deepcopy(env.actions["effort"])
        env.actions["other"].entity_name = "second"

    with pytest.raises(ValueError, match="Action 'other' entity_name"):
        write_random("Mjlab-Cartpole-Swingup", tmp_path / "bundle", edit)
