"""`describe`: the tables of every registered task agree with its managers."""

from __future__ import annotations

import functools
import importlib
import json
import math
import re
from typing import Any

import pytest
import torch
from commands import TASK

from mjlab.cli.main import main
from mjlab.envs import ManagerBasedRlEnv
from mjlab.scripts.describe import DescribeConfig, TaskDescription, describe
from mjlab.tasks.registry import list_tasks, load_env_cfg, load_rl_cfg
from mjlab.utils.config_json import config_json

STOCK = [name for name in list_tasks() if name.startswith("Mjlab-")]
KINDS = [
    "observations",
    "unmeasured",
    "actions",
    "commands",
    "rewards",
    "terminations",
    "events",
    "curriculum",
]
KINDS += ["metrics", "recorders", "entities", "sensors"]


@pytest.fixture(scope="module", params=STOCK)
def built(request):
    """Return an environment of a task, and its description."""
    cfg = load_env_cfg(request.param)
    cfg.scene.num_envs = 2
    env = ManagerBasedRlEnv(cfg, device="cpu")
    yield env, TaskDescription(request.param, DescribeConfig(), cfg, env)
    env.close()


@pytest.fixture(scope="module")
def rows(built):
    """Return the JSON of a task, as a reader of the printed JSON gets it."""
    return json.loads(json.dumps(built[1].as_json(), allow_nan=False))


def test_json_round_trips_and_has_every_kind_of_term(built, rows):
    assert rows == built[1].as_json()
    assert [key for key in rows if key in KINDS] == KINDS


def test_sizes_are_those_of_the_observations(built, rows):
    env, _ = built
    shapes = env.observation_manager.group_obs_term_dim
    expected = {
        (group, term): shape
        for group, terms in env.observation_manager.active_terms.items()
        for term, shape in zip(terms, shapes[group], strict=True)
    }
    sizes = {(row["group"], row["term"]): row["size"] for row in rows["observations"]}
    assert {key: math.prod(map(int, str(size).split("x"))) for key, size in sizes.items()} == {
        key: math.prod(shape) for key, shape in expected.items()
    }
    observations = env.observation_manager.compute()
    for group, shape in rows["observation_shapes"].items():
        assert list(observations[group].shape[1:]) == shape


def test_sizes_are_those_of_the_actions(built, rows):
    env, _ = built
    assert sum(row["size"] for row in rows["actions"]) == env.action_manager.total_action_dim
    for row in rows["actions"]:
        assert len(row["targets"]) == row["size"]


def test_terms_weights_and_modes_are_those_of_the_config(built, rows):
    cfg = built[0].cfg
    weights = {name: term.weight for name, term in cfg.rewards.items() if term is not None}
    assert {row["term"]: row["weight"] for row in rows["rewards"]} == weights
    modes = {name: term.mode for name, term in cfg.events.items() if term is not None}
    assert {row["term"]: row["mode"] for row in rows["events"]} == modes
    time_outs = {name: term.time_out for name, term in cfg.terminations.items() if term}
    assert {row["term"]: row["time-out"] for row in rows["terminations"]} == time_outs
    for kind in ("commands", "curriculum", "metrics", "recorders"):
        terms = [name for name, term in getattr(cfg, kind).items() if term is not None]
        assert [row["term"] for row in rows[kind]] == terms
    assert [row["entity"] for row in rows["entities"]] == list(built[0].scene.entities)


def test_functions_and_parameters_are_those_of_the_config(built, rows):
    for row in rows["rewards"]:
        term = built[0].cfg.rewards[row["term"]]
        assert row["function"] == term.func.__name__
        assert list(row["parameters"]) == list(term.params)


def written(value: Any) -> Any:
    """Return the config that a reader of the JSON would write: classes and functions by name."""
    if isinstance(value, list):
        return tuple(map(written, value))
    if isinstance(value, dict) and "class" in value:
        # None is the default of most fields, and of ids stands for a slice.
        fields = {key: written(item) for key, item in value.items() if item is not None}
        return fields.pop("class")(**fields)
    if isinstance(value, dict) and "partial" in value:
        parts = {key: written(item) for key, item in value.items()}
        return functools.partial(parts["partial"], *parts["args"], **parts["keywords"])
    if isinstance(value, dict) and value.keys() == {"items"}:
        return dict(written(value["items"]))
    if isinstance(value, dict):
        return {key: written(item) for key, item in value.items()}
    is_name = isinstance(value, str) and re.fullmatch(r"(mjlab|mujoco)[\w.]*:[\w.]+", value)
    return named(value) if is_name else value


def named(name: str) -> Any:
    module, _, path = name.partition(":")
    return functools.reduce(getattr, path.split("."), importlib.import_module(module))


@pytest.mark.parametrize("task", STOCK)
def test_a_config_written_from_the_json_is_that_of_the_task(task):
    for cfg in (load_env_cfg(task), load_rl_cfg(task, profile="cpu")):
        shown = json.loads(json.dumps(config_json(cfg), allow_nan=False))
        assert config_json(written(shown)) == shown


def test_a_task_written_from_the_json_steps_alike():
    rewards = []
    cfg = load_env_cfg("Mjlab-Velocity-Flat-Unitree-Go1", profile="cpu")
    for one in (cfg, written(config_json(cfg))):
        one.scene.num_envs, one.seed = 2, 1
        env = ManagerBasedRlEnv(one, device="cpu")
        env.reset()
        rewards.append(torch.stack([env.step(torch.ones(2, 12))[1] for _ in range(5)]))
        env.close()
    assert torch.equal(*rewards)


def test_functions_have_their_arguments_and_parts_their_names(built, rows):
    env, _ = built
    for row in rows["env_cfg"]["rewards"].values():
        arguments = rows["functions"][row["func"]]["arguments"]
        assert set(row["params"]) <= set(arguments)
        required = {name for name, one in arguments.items() if "default" not in one}
        assert required <= {"env", *row["params"]}
    for name, entity in env.scene.entities.items():
        assert tuple(rows["parts"][name]["joints"]) == tuple(entity.joint_names)
        assert tuple(rows["parts"][name]["sites"]) == tuple(entity.site_names)


def test_text_fits_and_names_every_term(built, rows):
    text = built[1].text(width=80)
    assert text.isascii()
    # The first two lines are sentences.
    assert max(map(len, text.splitlines()[2:])) <= 80
    words = set(text.split())
    for kind in KINDS:
        for row in rows[kind]:
            assert str(row.get("term") or row.get("entity") or row["sensor"]) in words


def test_markdown_tables_are_rectangles(built, rows):
    lines = [line for line in built[1].markdown().splitlines() if line.startswith("|")]
    tables = sum(bool(rows[kind]) for kind in KINDS)
    assert len(lines) == sum(len(rows[kind]) for kind in KINDS) + 2 * tables
    width = 0
    for line, following in zip(lines, [*lines[1:], ""], strict=True):
        if following.startswith("| ---"):
            width = line.count("|")
        assert line.replace(r"\|", "").count("|") == width


def test_a_notebook_shows_the_tables_of_env_scene_and_managers():
    cfg = load_env_cfg("Mjlab-Velocity-Flat-Unitree-Go1")
    env = ManagerBasedRlEnv(cfg, device="cpu")
    html = env._repr_html_()
    for part in (env.scene, env.observation_manager, env.reward_manager, env.command_manager):
        for table in part.tables():
            assert table.html() in html or not table.rows
        assert part._repr_html_().count("<table>") == sum(bool(t.rows) for t in part.tables())
        assert "\n" not in repr(part)
        assert all(table.text() in str(env) for table in part.tables() if table.rows)


def test_flags_select_profile_play_and_form(run_main):
    task = "Mjlab-Velocity-Flat-Unitree-Go1"
    outcome = run_main(main, "mjlab", "describe", task, "--profile", "cpu", "--play", "--json")
    assert outcome.status == 0, outcome.err
    play = json.loads(outcome.out)
    assert play == describe(task, DescribeConfig(profile="cpu", play=True)).as_json()
    assert play["profile"] == "cpu"
    assert play["play"] is True
    outcome = run_main(main, "mjlab", "describe", task, "--profile", "cpu", "--json")
    assert json.loads(outcome.out)["num_envs"] == load_env_cfg(task, profile="cpu").scene.num_envs
    train = describe(task).as_json()
    assert any(row["noise"] for row in train["observations"])
    assert not any(row["noise"] for row in play["observations"] if row["group"] == "actor")


def test_text_is_printed_by_default(run_main, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert run_main(main, "mjlab", "describe", TASK).out == f"{describe(TASK).text()}\n"


def test_flags_of_the_environment_are_described(run_main):
    flags = ("--env.rewards.smooth-reward.weight", "2.5", "--env.scene.num-envs", "7")
    outcome = run_main(main, "mjlab", "describe", TASK, *flags, "--json")
    rows = json.loads(outcome.out)
    assert (rows["rewards"][0]["weight"], rows["num_envs"]) == (2.5, 7)


@pytest.mark.parametrize(
    ("flags", "named"),
    [(("--json", "--markdown"), "--markdown"), (("--profile", "cup"), "'cpu'")],
)
def test_bad_flags_are_one_message(run_main, flags, named):
    outcome = run_main(main, "mjlab", "describe", TASK, *flags)
    assert outcome.status != 0
    assert not outcome.out
    assert named in outcome.message
