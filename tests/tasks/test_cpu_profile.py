"""`cpu_profile` returns profiles for any task: what eases training is apart from the policy."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.tasks.cpu_profile import cpu_profile
from mjlab.tasks.easing import ease_weight
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.utils.os import to_plain

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"
MIRROR = "mjlab.tasks.velocity.symmetry:mirror_left_right"


def ease_all(env_cfg, rl_cfg):
    """Edit what a task may: a term for the training alone, and one that is eased."""
    ease_weight(env_cfg, "action_rate_l2", 0.0, 100)
    names = ("track_linear_velocity", "action_rate_l2")
    env_cfg.rewards = {name: env_cfg.rewards[name] for name in names}
    rl_cfg.evaluation.num_episodes = 7


def observe_less(env_cfg, rl_cfg):
    del env_cfg.observations["actor"].terms["base_lin_vel"]


@settings(max_examples=20, deadline=None)
@given(
    st.fixed_dictionaries(
        {},
        optional={
            "easing": st.just(ease_all),
            "num_envs": st.integers(1, 4096),
            "physics_steps": st.integers(1, 3),
            "simple_contacts": st.booleans(),
            "unpushed_samples": st.integers(1, 10**7),
            "mirror": st.just(MIRROR),
        },
    )
)
def test_the_policy_leaves_the_environment_alone(options):
    plain, env_cfg, rl_cfg = load_env_cfg(TASK), load_env_cfg(TASK), load_rl_cfg(TASK)
    profile = cpu_profile(**options)
    profile.policy(env_cfg, rl_cfg)
    assert to_plain(env_cfg) == to_plain(plain)
    assert rl_cfg.actor.hidden_dims == (128, 64)
    profile.easing(env_cfg, rl_cfg)
    assert env_cfg.scene.num_envs == options.get("num_envs", 512)
    assert env_cfg.decimation == options.get("physics_steps", plain.decimation)
    assert (len(env_cfg.rewards) == 2) == ("easing" in options)
    assert (rl_cfg.evaluation.num_episodes == 7) == ("easing" in options)


def test_a_task_sets_more_of_its_policy():
    env_cfg = load_env_cfg(TASK)
    cpu_profile(policy=observe_less).policy(env_cfg, load_rl_cfg(TASK))
    assert "base_lin_vel" not in env_cfg.observations["actor"].terms
