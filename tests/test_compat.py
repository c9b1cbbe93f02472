"""Older names and defaults: everything in the table resolves, warns once, and does its work."""

from __future__ import annotations

import importlib
import warnings

import pytest

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

    with pytest.warns(FutureWarning, match=r"today it is mjlab.actuator.xml_actuator") as seen:
        cfg = mjlab.actuator.XmlMotorActuatorCfg
        assert mjlab.actuator.XmlMotorActuatorCfg is cfg
    assert len(seen) == 1
    assert cfg is mjlab.actuator.XmlActuatorCfg


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


def test_fields_once_optional_are_filled_in():
    with pytest.warns(FutureWarning, match=r"CollisionCfg.condim has to be given"):
        cfg = CollisionCfg(geom_names_expr=(".*",), contype=2)  # ty: ignore
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
    import numpy as np
    from scipy.spatial.transform import Rotation

    w, *xyz = older.rotation_quat_from_vectors((0, 0, 2), to)
    turned = Rotation.from_quat([*xyz, w]).apply([0, 0, 1])
    np.testing.assert_allclose(turned, np.array(to) / np.linalg.norm(to), atol=1e-9)
