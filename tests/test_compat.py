"""Older names and defaults: everything in the table resolves, warns once, and does its work."""

from __future__ import annotations

import copy
import importlib
import pickle
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from mjlab import compat
from mjlab.compat import older
from mjlab.managers import EventTermCfg
from mjlab.rl import RslRlModelCfg
from mjlab.utils.spec_config import CollisionCfg


@pytest.fixture(autouse=True)
def _forget_warnings():
    compat._warn_once.cache_clear()


ALL_NAMES = [(module, name) for module, names in compat._NAMES.items() for name in names]


@pytest.mark.parametrize(("module", "name"), ALL_NAMES)
def test_every_older_name_resolves_in_its_module(module, name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert getattr(importlib.import_module(module), name) is not None


@pytest.mark.parametrize("module", sorted({module for module, _ in ALL_NAMES}))
def test_a_name_that_never_was_is_an_attribute_error(module):
    with pytest.raises(AttributeError, match="no_such_name"):
        importlib.import_module(module).no_such_name


def test_a_class_warns_once_with_todays_spelling():
    import mjlab.actuator

    with pytest.warns(FutureWarning, match=r"use mjlab.actuator.xml_actuator") as seen:
        cfg = mjlab.actuator.XmlMotorActuatorCfg
        assert mjlab.actuator.XmlMotorActuatorCfg is cfg
    assert len(seen) == 1
    assert cfg is mjlab.actuator.XmlActuatorCfg


@pytest.mark.parametrize("name", ["randomize_pd_gains", "randomize_field"])
def test_an_older_function_can_be_copied_and_pickled(name):
    from mjlab.envs import mdp

    function = getattr(mdp, name)
    assert pickle.loads(pickle.dumps(function)) is function
    assert copy.deepcopy(function) is function


def test_names_that_modules_of_1_6_import_are_there_without_a_warning():
    from mjlab.entity import Entity
    from mjlab.envs.mdp import rewards
    from mjlab.scripts import play

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert rewards.Entity is Entity
        assert callable(play.load_env_cfg)


def test_star_import_brings_older_functions_and_stays_quiet():
    namespace: dict[str, object] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        exec("from mjlab.envs.mdp import *", namespace)
    assert callable(namespace["randomize_field"])
    assert "time_out" in namespace


def test_an_older_function_keeps_what_it_declares_and_warns_when_called():
    from mjlab.envs import mdp

    older = mdp.randomize_pd_gains
    assert older.model_fields == mdp.dr.pd_gains.model_fields
    with (
        pytest.warns(FutureWarning, match="mjlab.envs.mdp.dr.pd_gains"),
        pytest.raises(TypeError),
    ):
        older()


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"stochastic": False, "init_noise_std": 0.5}, None),
        ({"stochastic": True}, {"init_std": 1.0, "std_type": "scalar"}),
        ({"init_noise_std": 0.5}, None),
        (
            {"init_noise_std": 0.5, "noise_std_type": "log", "stochastic": True},
            {"init_std": 0.5, "std_type": "log"},
        ),
    ],
)
def test_older_noise_fields_become_a_distribution(given, expected):
    with pytest.warns(FutureWarning, match="distribution_cfg"):
        distribution = RslRlModelCfg(**given).distribution_cfg
    if expected is None:
        assert distribution is None
    else:
        assert distribution == {"class_name": "GaussianDistribution", **expected}


def test_collision_fields_may_be_omitted():
    cfg = CollisionCfg(geom_names_expr=(".*",), contype=2)
    assert (cfg.contype, cfg.conaffinity, cfg.condim, cfg.priority) == (2, 1, 3, 0)


def test_a_flag_without_effect_is_accepted():
    with pytest.warns(FutureWarning, match="domain_randomization"):
        cfg = EventTermCfg(func=print, mode="reset", domain_randomization=True)  # ty: ignore
    assert cfg.mode == "reset"


def test_todays_spelling_does_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        CollisionCfg(geom_names_expr=(".*",), contype=1, conaffinity=1, condim=3, priority=0)
        RslRlModelCfg()


def test_files_of_a_folder_become_assets(tmp_path):
    (tmp_path / "a.stl").write_bytes(b"mesh")
    assets: dict[str, bytes] = {}
    older.update_assets(assets, tmp_path, meshdir="meshes", glob="*.stl")
    assert assets == {"meshes/a.stl": b"mesh"}


@pytest.mark.parametrize("to", [(0, 0, 1), (0, 1, 0), (0, 0, -1), (1, 2, 3)])
def test_the_shortest_rotation_turns_one_vector_into_the_other(to):
    from scipy.spatial.transform import Rotation

    w, *xyz = older.rotation_quat_from_vectors((0, 0, 2), to)
    turned = Rotation.from_quat([*xyz, w]).apply([0, 0, 1])
    np.testing.assert_allclose(turned, np.array(to) / np.linalg.norm(to), atol=1e-9)


@pytest.fixture(scope="module")
def cartpole():
    from mjlab.envs import ManagerBasedRlEnv, mdp
    from mjlab.managers import MetricsTermCfg
    from mjlab.tasks.registry import load_env_cfg

    cfg = load_env_cfg("Mjlab-Cartpole-Balance")
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = 2, 1, "native"
    cfg.metrics = {"acceleration": MetricsTermCfg(func=mdp.mean_action_acc)}
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    for sign in (1.0, -1.0, 1.0):
        env.step(torch.full((2, 1), sign))
    return env


ignore_older = pytest.mark.filterwarnings("ignore:.*older:FutureWarning")


@ignore_older
def test_managers_answer_attributes_of_earlier_releases(cartpole):
    metrics, observations = cartpole.metrics_manager, cartpole.observation_manager
    assert torch.equal(metrics._step_count, torch.tensor([3, 3]))
    assert list(metrics._episode_sums) == ["acceleration"]
    assert (metrics._episode_sums["acceleration"] > 0).all()
    cfgs = observations._group_obs_term_cfgs
    assert {group: len(terms) for group, terms in cfgs.items()} == {
        group: len(terms) for group, terms in observations.active_terms.items()
    }
    name = observations.active_terms["actor"][0]
    assert cfgs["actor"][0] is observations.get_term_cfg("actor", name)
    terminations = cartpole.termination_manager
    terminations.time_outs[1] = True
    assert terminations._truncated_buf.tolist() == [False, True]
    terminations._truncated_buf[1] = False
    assert not terminations.time_outs.any()


@ignore_older
def test_running_returns_are_read_by_name(cartpole):
    rewards = cartpole.reward_manager
    sums = rewards._episode_sums
    assert list(sums) == rewards.active_terms
    (name, *_) = sums
    assert sums[name][torch.tensor([1])].shape == (1,)
    assert torch.equal(sums[name], rewards.episode_sum(name))
    assert (sums[name] > 0.0).all()
    sums[name][1] = 0.0
    assert rewards.episode_sum(name)[1] == 0.0


@ignore_older
def test_terms_are_listed_by_older_attributes(cartpole):
    observations, events = cartpole.observation_manager, cartpole.event_manager
    for name in ("dim", "term_dim", "concatenate"):
        value = getattr(observations, f"_group_obs_{name}")
        assert value == getattr(observations, f"group_obs_{name}")
    assert observations._group_obs_term_names == observations.active_terms
    assert events._mode_term_names == events.active_terms
    name = events.active_terms["reset"][0]
    assert events._mode_term_cfgs["reset"][0] is events.get_term_cfg(name)
    assert cartpole.curriculum_manager._curriculum_state == {}


def test_applied_generalized_forces_warn_once_and_are_read(cartpole):
    robot = next(e for e in cartpole.scene.entities.values() if e.num_joints == 2)
    cartpole.sim.data.qfrc_applied[:] = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    with pytest.warns(FutureWarning, match=r"EntityData.generalized_force"):
        force = robot.data.generalized_force
    assert force.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert robot.data.generalized_force.shape == (2, 2)


def test_an_attribute_that_is_set_hides_the_older_one():
    from mjlab.managers import TerminationManager

    class Own(TerminationManager):
        def __init__(self):
            self._truncated_buf = "own"

    assert Own()._truncated_buf == "own"


@ignore_older
def test_flat_patches_of_a_field_of_integers_are_where_it_is_flat():
    from mjlab.terrains import FlatPatchSamplingCfg
    from mjlab.terrains.heightfield_terrains import _compute_flat_patches

    rng = np.random.default_rng(0)
    noise = 100 + (rng.random((40, 60)) * 500).astype(np.int16)
    noise[5:15, 40:50] = 300
    cfg = FlatPatchSamplingCfg(num_patches=3, patch_radius=0.3, max_height_diff=0.1)
    patches = _compute_flat_patches(noise, 0.005, 0.1, 0.3, {"spawn": cfg}, rng)["spawn"]
    assert patches.shape == (3, 3)
    x, y, z = patches.T
    assert ((x > 4.0) & (x < 5.0) & (y > 0.5) & (y < 1.5)).all()
    np.testing.assert_allclose(z, 0.005 * (300 - noise.min()) + 0.3)
    assert _compute_flat_patches(noise, 0.005, 0.1, 0.3, None, rng) is None


@ignore_older
def test_the_demo_motion_and_policy_ship():
    from mjlab.scripts import gcs
    from mjlab.tasks.tracking.motion_file import read_motion

    motion = read_motion(gcs.ensure_default_motion())
    assert motion.num_frames > 10
    assert str(gcs.ensure_asset_downloaded("demo_motion.npz")) == gcs.ensure_default_motion()
    assert Path(gcs.ensure_default_checkpoint()).is_file()
    with pytest.raises(ValueError, match=r"demo_motion.npz.*'x'"):
        gcs.ensure_asset_downloaded("x")


def test_passing_names_on_imports_nothing():
    # Modules of the table that themselves load only a few others, in a separate process.
    code = (
        "import sys, mjlab.compat, mjlab.tasks.registry, mjlab.scripts.gcs; "
        "print([name for name in ('torch', 'mujoco', 'mjlab.compat.older') if name in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
