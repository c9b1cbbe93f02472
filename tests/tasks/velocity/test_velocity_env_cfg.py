"""Task configs: shared objects, base config, play mode."""

from __future__ import annotations

import copy

import pytest
import torch
from velocity_tasks import GO1_FLAT, GO1_ROUGH

from mjlab.tasks.registry import list_tasks, load_env_cfg, load_rl_cfg
from mjlab.tasks.velocity.config.g1 import unitree_g1_flat_env_cfg, unitree_g1_rough_env_cfg
from mjlab.tasks.velocity.config.g1.env_cfgs import unitree_g1_rough_no_state_estimation_env_cfg
from mjlab.tasks.velocity.config.go1 import unitree_go1_flat_env_cfg, unitree_go1_rough_env_cfg
from mjlab.tasks.velocity.config.go1.env_cfgs import unitree_go1_flat_no_state_estimation_env_cfg
from mjlab.tasks.velocity.velocity_env_cfg import make_velocity_env_cfg
from mjlab.terrains.config import ROUGH_TERRAINS_CFG
from mjlab.utils.os import to_plain

MAKERS = [
    make_velocity_env_cfg,
    unitree_go1_rough_env_cfg,
    unitree_go1_flat_env_cfg,
    unitree_g1_rough_env_cfg,
    unitree_g1_flat_env_cfg,
    unitree_go1_flat_no_state_estimation_env_cfg,
    unitree_g1_rough_no_state_estimation_env_cfg,
]
SUFFIX = "-No-State-Estimation"


def mutable_parts(value: object, path: str = "", found: dict[int, str] | None = None):
    """Return the ids of all lists, dicts and config objects below `value`, with their paths."""
    import dataclasses

    found = {} if found is None else found
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        if id(value) in found:
            return found
        found[id(value)] = path
        items = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}.items()
    elif isinstance(value, dict):
        found[id(value)] = path
        items = value.items()
    elif isinstance(value, (list, tuple)):
        items = enumerate(value)
    else:
        return found
    for key, item in items:
        mutable_parts(item, f"{path}.{key}", found)
    return found


@pytest.mark.parametrize("make", MAKERS)
def test_two_configs_of_a_task_share_nothing_that_can_be_changed(make):
    one, other = make(), make()
    shared = mutable_parts(one).keys() & mutable_parts(other).keys()
    allowed = ("lights", "textures", "materials")
    paths = [mutable_parts(one)[key] for key in shared]
    # Defaults of all terrains are constants of the class.
    assert not [p for p in paths if not any(word in p for word in allowed)]


def test_editing_the_terrain_of_a_task_does_not_edit_the_preset():
    before = copy.deepcopy(ROUGH_TERRAINS_CFG)
    cfg = make_velocity_env_cfg()
    generator = cfg.scene.terrain.terrain_generator  # ty: ignore
    generator.sub_terrains["pyramid_stairs"].step_height_range = (0.0, 9.0)
    generator.num_rows = 1
    assert before == ROUGH_TERRAINS_CFG
    again = make_velocity_env_cfg().scene.terrain.terrain_generator  # ty: ignore
    assert again.sub_terrains["pyramid_stairs"].step_height_range == (0.0, 0.1)


def test_the_base_config_is_that_of_the_g1_but_for_what_a_robot_brings():
    base, g1 = make_velocity_env_cfg(), unitree_g1_rough_env_cfg()
    plain_base, plain_g1 = to_plain(base), to_plain(g1)
    assert base.scene.entities == {}
    assert [sensor.name for sensor in base.scene.sensors] == ["terrain_scan", "foot_height_scan"]
    assert plain_base["observations"]["actor"] == plain_g1["observations"]["actor"]
    assert list(plain_base["observations"]["critic"]["terms"]) == list(
        plain_g1["observations"]["critic"]["terms"]
    )
    assert plain_base["terminations"] == plain_g1["terminations"]
    assert plain_base["curriculum"] == plain_g1["curriculum"]
    assert plain_base["rewards"].keys() == plain_g1["rewards"].keys() - {"self_collisions"}
    assert base.rewards["angular_momentum"].weight == 0.0  # ty: ignore
    assert base.rewards["body_ang_vel"].weight == 0.0  # ty: ignore
    assert base.actions["joint_pos"].scale == 0.5  # ty: ignore
    assert base.commands["twist"].viz.z_offset == 0.2  # ty: ignore
    assert (base.sim.nconmax, base.sim.mujoco.ccd_iterations) == (35, 50)
    assert base.sim.contact_sensor_maxmatch == 64
    assert not base.scene.terrain.terrain_generator.curriculum  # ty: ignore


@pytest.mark.parametrize("play", [False, True])
@pytest.mark.parametrize(
    "task", [t for t in list_tasks() if t.startswith("Mjlab-Velocity") and t.endswith(SUFFIX)]
)
def test_only_the_actor_lacks_state_estimation(task, play):
    cfg, whole = (load_env_cfg(t, play=play) for t in (task, task.removesuffix(SUFFIX)))
    actor, complete = cfg.observations["actor"], whole.observations["actor"]
    removed = complete.terms.keys() - actor.terms.keys()
    assert removed == {"base_lin_vel"} | (complete.terms.keys() & {"height_scan"})
    assert actor.history_length == (10 if "height_scan" in removed else None)
    for name in removed:
        del complete.terms[name]
    actor.history_length = complete.history_length
    assert list(actor.terms) == list(complete.terms)
    assert to_plain(cfg) == to_plain(whole)
    learners = [to_plain(load_rl_cfg(t)) for t in (task, task.removesuffix(SUFFIX))]
    assert learners[0] == learners[1]


def take_from_base(kind: str, name: str):
    """Return an edit that puts one term of the base config, unfilled, in place of all others."""

    def edit(cfg):
        setattr(cfg, kind, {name: getattr(make_velocity_env_cfg(), kind)[name]})

    return edit


def test_tolerances_left_empty_are_an_error(make_env):
    with pytest.raises(ValueError, match="'pose': std_standing: .*missing"):
        make_env(edit=take_from_base("rewards", "pose"))


@pytest.mark.parametrize(
    ("kind", "name", "field"),
    [
        ("events", "foot_friction", "geom_names"),
        ("events", "base_com", "body_names"),
        ("rewards", "foot_slip", "site_names"),
    ],
)
def test_selections_left_empty_warn_once(make_env, kind, name, field):
    with pytest.warns(UserWarning, match=f"'{name}', .*'asset_cfg': expected {field}") as caught:
        make_env(edit=take_from_base(kind, name))
    assert len([one for one in caught if "got none" in str(one.message)]) == 1


@pytest.mark.parametrize("sensor", [0, 1])
def test_sensors_of_the_base_config_that_are_not_filled_in_are_refused(make_env, sensor):
    def edit(cfg):
        base = make_velocity_env_cfg().scene.sensors[sensor]
        kept = tuple(s for s in cfg.scene.sensors if s.name != base.name)
        cfg.scene.sensors = (*kept, base)

    with pytest.raises(ValueError, match=("terrain_scan", "foot_height_scan")[sensor]):
        make_env(edit=edit)


@pytest.mark.parametrize("task", [GO1_FLAT, GO1_ROUGH])
def test_to_play_the_terrain_is_drawn_before_the_robot_is_put_on_it(task):
    events = [
        name
        for name, term in load_env_cfg(task, play=True).events.items()
        if term is not None and term.mode == "reset"
    ]
    assert events[0] == "randomize_terrain"
    assert len(events) == 3


def test_a_robot_to_play_with_starts_on_the_terrain_that_was_drawn(make_env):
    env = make_env(GO1_ROUGH, play=True, num_envs=32)
    for _ in range(2):
        before = env.scene.env_origins.clone()
        env.reset()
        assert not torch.equal(env.scene.env_origins, before)
        offset = env.scene["robot"].data.root_link_pos_w - env.scene.env_origins
        assert (offset[:, :2].abs() <= 0.5 + 1e-5).all()


def test_playing_ends_no_episode_by_time(make_env):
    env = make_env(GO1_FLAT, play=True)
    env.reset()
    assert env.max_episode_length_s == 1e9
    assert env.max_episode_length > 10**10


@pytest.mark.parametrize(
    ("task", "actor", "critic", "actions"),
    [
        (GO1_ROUGH, 235, 259, 12),
        (GO1_FLAT, 48, 72, 12),
        ("Mjlab-Velocity-Rough-Unitree-G1", 286, 298, 29),
        ("Mjlab-Velocity-Flat-Unitree-G1", 99, 111, 29),
        (GO1_FLAT + SUFFIX, 45, 72, 12),
        (GO1_ROUGH + SUFFIX, 450, 259, 12),
    ],
)
def test_observations_and_actions_are_as_wide_as_documented(make_env, task, actor, critic, actions):
    env = make_env(task, num_envs=2)
    observations, _ = env.reset()
    assert observations["actor"].shape == (2, actor)
    assert observations["critic"].shape == (2, critic)
    assert env.action_manager.total_action_dim == actions


def test_friction_of_the_feet_is_drawn_on_three_axes_that_compose(make_env):
    env = make_env(num_envs=64)
    geoms = [
        env.sim.mj_model.geom(f"robot/{f}_foot_collision").id for f in ("FR", "FL", "RR", "RL")
    ]
    friction = env.sim.model.geom_friction[:, geoms]
    bounds = ((0.3, 1.5), (1e-4, 2e-2), (1e-5, 5e-3))
    for axis, (low, high) in enumerate(bounds):
        values = friction[:, :, axis]
        # The four feet of a robot share it, and robots differ.
        assert (values == values[:, :1]).all()
        assert len(values[:, 0].unique()) > 60
        assert values.min() >= low * 0.999
        assert values.max() <= high * 1.001
        middle = (low + high) / 2 if axis == 0 else (low * high) ** 0.5
        assert 0.2 < (values[:, 0] < middle).float().mean() < 0.8
