"""The `cpu` profile: settings of the velocity tasks for a few cores.

A few cores step some ten thousand environments a second, a hundredth of a GPU. Under the task's own
settings a robot has not left its first idea by then, which is to stand still: trying to move costs
more penalty than it earns. So the profile makes the task easier to learn, not easier to pass:

- Penalties start at a fraction of their weight and grow to it, those that lift the feet sooner than
  the others, and so do pushes; a reward for feet in the air, which the task has but does not weigh,
  fades out meanwhile.
- Contacts have no rolling and torsional friction, and a pyramidal friction cone. The solver then
  takes half the time.
- The mirror image of each sample is one more sample. Without it, a policy walks as soon, and stumbles
  far longer in the directions that it has seen least.
- Batches and networks are small, a policy may change more in an iteration, and rewards far away count
  less: what a leg does shows within a second.

Evaluations, `play` and `evaluate` undo the first two: what they show is the task as it is.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.envs import mdp as envs_mdp
from mjlab.managers.curriculum_manager import CurriculumTermCfg
from mjlab.rl.config import RslRlOnPolicyRunnerCfg, gaussian_distribution
from mjlab.tasks.simple_contacts import simplify_contacts

_Edit = Callable[[ManagerBasedRlEnvCfg], None]

_AIR_TIME, _PUSH, _EASED_PUSH = "air_time", "push_robot", "eased_push_robot"
_NUM_ENVS = 512
_PENALTY_AT_FIRST = 0.02
_AIR_TIME_AT_FIRST = 0.5
_EASED_SAMPLES = 6_000_000
# Whoever drags the feet falls at each change of command.
_LIFTING = ("foot_clearance", "foot_swing_height")
_LIFTING_EASED_SAMPLES = 2_000_000
_UNPUSHED_SAMPLES = 2_000_000
_NUM_STAGES = 60


def cpu(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    """Edit the configs of a velocity task in place."""
    env_cfg.scene.num_envs = _NUM_ENVS
    undo_contacts = simplify_contacts(env_cfg)
    rl_cfg.evaluation.prepare_env = _undoing(env_cfg, undo_contacts)
    _ease_rewards(env_cfg)
    _ease_pushes(env_cfg)
    _learn_from_few_samples(rl_cfg)
    evaluation = rl_cfg.evaluation
    evaluation.num_episodes = 200
    evaluation.trigger_return = 3600.0
    evaluation.min_interval = 40
    evaluation.solved_below = {"lin_vel_error": 0.25, "ang_vel_error": 0.35, "failure_rate": 0.05}


def cpu_humanoid(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    """Edit the configs of a humanoid's velocity task in place.

    Solved means that it stands and steps: four of five episodes last to their end, and the command is
    followed better than standing still would.
    """
    cpu(env_cfg, rl_cfg)
    # More joints need less noise each for a body to be thrown about as much.
    rl_cfg.algorithm.entropy_coef = 0.005
    rl_cfg.actor.hidden_dims = rl_cfg.critic.hidden_dims = (256, 128)
    rl_cfg.max_iterations = 6000
    evaluation = rl_cfg.evaluation
    evaluation.trigger_return = 2500.0
    evaluation.min_interval = 100
    evaluation.solved_below = {"lin_vel_error": 0.4, "failure_rate": 0.2}


def _eased_weights(env_cfg: ManagerBasedRlEnvCfg) -> dict[str, float]:
    """Return the weights at which eased rewards end, by name: those that the task gives them."""
    weights = {name: term.weight for name, term in env_cfg.rewards.items() if term is not None}
    return {name: weight for name, weight in weights.items() if weight < 0 or name == _AIR_TIME}


def _ease_rewards(env_cfg: ManagerBasedRlEnvCfg) -> None:
    for name, last in _eased_weights(env_cfg).items():
        first = _AIR_TIME_AT_FIRST if name == _AIR_TIME else _PENALTY_AT_FIRST * last
        _change_weight(env_cfg, name, first, last)


def _change_weight(env_cfg: ManagerBasedRlEnvCfg, name: str, first: float, last: float) -> None:
    """Let the weight of a reward go from `first` to `last`, a little at a time."""
    steps = (_LIFTING_EASED_SAMPLES if name in _LIFTING else _EASED_SAMPLES) // _NUM_ENVS
    stages = [
        {
            "step": stage * steps // _NUM_STAGES,
            "weight": first + (last - first) * stage / _NUM_STAGES,
        }
        for stage in range(_NUM_STAGES + 1)
    ]
    _set_weight(env_cfg, name, first)
    env_cfg.curriculum[f"eased_{name}"] = CurriculumTermCfg(
        func=envs_mdp.reward_curriculum, params={"reward_name": name, "stages": stages}
    )


def _set_weight(env_cfg: ManagerBasedRlEnvCfg, name: str, weight: float) -> None:
    term = env_cfg.rewards[name]
    if term is not None:
        term.weight = weight


def _ease_pushes(env_cfg: ManagerBasedRlEnvCfg) -> None:
    push = env_cfg.events.get(_PUSH)
    if push is not None:
        params = {"event_name": _PUSH, "velocity_range": push.params["velocity_range"]}
        params["steps"] = _UNPUSHED_SAMPLES // _NUM_ENVS
        env_cfg.curriculum[_EASED_PUSH] = CurriculumTermCfg(func=growing_pushes, params=params)


def growing_pushes(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | slice,
    event_name: str,
    velocity_range: dict[str, tuple[float, float]],
    steps: int,
) -> float:
    """Let pushes grow from nothing to `velocity_range` over `steps` environment steps.

    Returns the fraction that they have reached, for logging.
    """
    fraction = min(env.common_step_counter / steps, 1.0)
    params = env.event_manager.get_term_cfg(event_name).params
    params["velocity_range"] = {
        axis: (fraction * low, fraction * high) for axis, (low, high) in velocity_range.items()
    }
    return fraction


def _undoing(env_cfg: ManagerBasedRlEnvCfg, undo_contacts: _Edit) -> _Edit:
    """Return what undoes the contacts, and makes rewards and pushes what they are in `env_cfg` now."""
    weights = _eased_weights(env_cfg)

    def undo_easing(eased: ManagerBasedRlEnvCfg) -> None:
        undo_contacts(eased)
        for name, weight in weights.items():
            if eased.curriculum.pop(f"eased_{name}", None) is not None:
                _set_weight(eased, name, weight)
        push, growing = eased.events.get(_PUSH), eased.curriculum.pop(_EASED_PUSH, None)
        if push is not None and growing is not None:
            # Those of a training under way are as large as they have grown by then.
            push.params["velocity_range"] = growing.params["velocity_range"]

    return undo_easing


def _learn_from_few_samples(rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    rl_cfg.actor.hidden_dims = rl_cfg.critic.hidden_dims = (128, 64)
    rl_cfg.actor.distribution_cfg = gaussian_distribution(0.8)
    rl_cfg.algorithm.entropy_coef = 0.01
    rl_cfg.algorithm.desired_kl = 0.03
    rl_cfg.algorithm.gamma = 0.97
    rl_cfg.algorithm.symmetry_cfg = {
        "data_augmentation_func": "mjlab.tasks.velocity.symmetry:mirror_left_right",
        "use_data_augmentation": True,
    }
    rl_cfg.num_steps_per_env = 12
    rl_cfg.max_iterations = 2000
    rl_cfg.save_interval = 100
