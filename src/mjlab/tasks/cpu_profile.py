"""Profile factory for training on a few CPU cores: any task, stock or one's own.

    register_mjlab_task(..., profiles={"cpu": cpu_profile(simple_contacts=True)})

A few cores step some ten thousand environments a second, a hundredth of a GPU. So batches and networks
are small, a policy may change more in an iteration, and rewards far away count less. What else makes a
task easier to learn depends on the task: contacts that are quicker to solve, longer physics steps,
pushes that begin later, mirror images. None of it makes the task easier to pass: evaluations, `evaluate`
and `play` undo it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnvCfg
    from mjlab.rl.config import RslRlOnPolicyRunnerCfg
    from mjlab.tasks.easing import Undo
    from mjlab.tasks.registry import Profile

    TaskEdit = Callable[[ManagerBasedRlEnvCfg, RslRlOnPolicyRunnerCfg], Undo | None]


def cpu_profile(
    task: TaskEdit | None = None,
    *,
    num_envs: int = 512,
    num_steps_per_env: int = 12,
    hidden_dims: tuple[int, ...] = (128, 64),
    init_std: float | None = None,
    entropy_coef: float = 0.01,
    desired_kl: float = 0.03,
    gamma: float = 0.97,
    max_iterations: int = 2000,
    save_interval: int = 100,
    physics_steps: int | None = None,
    simple_contacts: bool = False,
    unpushed_samples: int | None = None,
    mirror: str | None = None,
) -> Profile:
    """Return a profile for learning by PPO on a few cores.

    Args:
        task: Edits both configs in place for what only this task needs; called last. Returns what
            undoes that for evaluations, or None. Curriculum terms of `mjlab.tasks.easing` need no
            undoing.
        num_envs: Number of environments.
        num_steps_per_env: Environment steps of an iteration.
        hidden_dims: Widths of the hidden layers of both networks.
        init_std: Standard deviation of actions, before any learning. None: the task's.
        entropy_coef: Weight of the entropy bonus.
        desired_kl: Change of the policy (nats) to which the learning rate is adapted.
        gamma: Discount factor per environment step.
        max_iterations: Iterations of a run.
        save_interval: Iterations between checkpoints.
        physics_steps: Physics steps of an environment step, fewer and longer ones than the task's.
            None: the task's.
        simple_contacts: Contacts without rolling and torsional friction, with pyramidal cones.
        unpushed_samples: Environment steps, over all environments, in which the pushes of the event
            `push_robot` grow from nothing to what they are. None: they are whole from the start.
        mirror: Function that appends mirror images, as `module:function`, such as
            `mjlab.tasks.velocity.symmetry:mirror_left_right`. None: no mirror images.
    """

    def profile(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
        # Not before it is used: a task is registered without torch.
        from mjlab.rl.config import gaussian_distribution
        from mjlab.tasks.easing import (
            coarsen_physics,
            drop_easing,
            ease_pushes,
            simplify_contacts,
            undo_all,
        )

        env_cfg.scene.num_envs = num_envs
        undos = [drop_easing]
        if physics_steps is not None:
            undos.append(coarsen_physics(env_cfg, physics_steps))
        if simple_contacts:
            undos.append(simplify_contacts(env_cfg))
        if unpushed_samples is not None:
            # Curricula count steps; more environments are eased for as many of them.
            ease_pushes(env_cfg, unpushed_samples // num_envs)
        rl_cfg.actor.hidden_dims = rl_cfg.critic.hidden_dims = hidden_dims
        if init_std is not None:
            rl_cfg.actor.distribution_cfg = gaussian_distribution(init_std)
        rl_cfg.num_steps_per_env, rl_cfg.max_iterations = num_steps_per_env, max_iterations
        rl_cfg.save_interval = save_interval
        algorithm = rl_cfg.algorithm
        algorithm.entropy_coef, algorithm.desired_kl = entropy_coef, desired_kl
        algorithm.gamma = gamma
        if mirror is not None:
            algorithm.symmetry_cfg = {
                "data_augmentation_func": mirror,
                "use_data_augmentation": True,
            }
        undo = None if task is None else task(env_cfg, rl_cfg)
        rl_cfg.evaluation.prepare_env = undo_all(undos if undo is None else [*undos, undo])

    return profile
