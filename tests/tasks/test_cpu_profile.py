"""`cpu_profile` returns profiles for any task, and evaluations undo them."""

from __future__ import annotations

import copy
from dataclasses import asdict

from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.tasks.cpu_profile import cpu_profile
from mjlab.tasks.easing import ease_weight, replace_rewards
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.utils.os import dump_yaml

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"
MIRROR = "mjlab.tasks.velocity.symmetry:mirror_left_right"


def ease_all(env_cfg, rl_cfg):
    """Edit what a task may: a term for the training alone, and one that is eased."""
    ease_weight(env_cfg, "action_rate_l2", 0.0, 100)
    fewer = {name: env_cfg.rewards[name] for name in ("track_linear_velocity", "action_rate_l2")}
    return replace_rewards(env_cfg, fewer)


@settings(max_examples=20, deadline=None)
@given(
    st.fixed_dictionaries(
        {},
        optional={
            "task": st.just(ease_all),
            "num_envs": st.integers(1, 4096),
            "physics_steps": st.integers(1, 3),
            "simple_contacts": st.booleans(),
            "unpushed_samples": st.integers(1, 10**7),
            "mirror": st.just(MIRROR),
        },
    )
)
def test_evaluations_undo_whatever_a_profile_makes_easier(tmp_path_factory, options):
    plain = load_env_cfg(TASK)
    eased, rl_cfg = copy.deepcopy(plain), load_rl_cfg(TASK)
    cpu_profile(**options)(eased, rl_cfg)
    assert eased.scene.num_envs == options.get("num_envs", 512)
    eased.scene.num_envs = plain.scene.num_envs
    rl_cfg.evaluation.prepare_env(eased)
    folder = tmp_path_factory.mktemp("cfg")
    for name, cfg in (("eased.yaml", eased), ("plain.yaml", plain)):
        dump_yaml(folder / name, asdict(cfg))
    assert (folder / "eased.yaml").read_text() == (folder / "plain.yaml").read_text()
