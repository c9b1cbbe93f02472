"""Profile factory for training on a few CPU cores, for built-in and custom tasks.

    register_mjlab_task(..., profiles={"cpu": cpu_profile(simple_contacts=True)})

A few cores simulate about 10,000 environment steps per second, a hundredth of a GPU. Therefore batches
and networks are small, the KL target is larger, and the discount factor is smaller. Further
simplifications depend on the task: cheaper contacts, longer physics timesteps, delayed pushes, mirror
images. None of them makes the task easier to pass: evaluations, `evaluate` and `play` use the task's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.tasks.registry import Profile

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnvCfg
    from mjlab.rl.config import RslRlBaseRunnerCfg, RslRlOnPolicyRunnerCfg
    from mjlab.tasks.registry import ProfileEdit


def cpu_profile(
    easing: ProfileEdit | None = None,
    *,
    policy: ProfileEdit | None = None,
    num_envs: int = 512,
    num_steps_per_env: int = 12,
    hidden_dims: tuple[int, ...] = (128, 64),
    init_std: float | None = None,
    entropy_coef: float = 0.01,
    desired_kl: float = 0.05,
    gamma: float = 0.97,
    num_epochs: int | None = None,
    max_iterations: int = 2000,
    save_interval: int = 100,
    physics_steps: int | None = None,
    simple_contacts: bool = False,
    unpushed_samples: int | None = None,
    mirror: str | None = None,
) -> Profile:
    """Return a profile for PPO training on a few cores.

    Args:
        easing: Task-specific easing, as in `Profile`; called after that of the other arguments.
        policy: Task-specific settings of the policy, as in `Profile`; called after those of the other
            arguments.
        num_envs: Number of environments.
        num_steps_per_env: Number of environment steps per iteration.
        hidden_dims: Hidden layer widths of actor and critic.
        init_std: Initial standard deviation of actions. None: the task's.
        entropy_coef: Entropy bonus coefficient.
        desired_kl: Target KL divergence (nats) of the adaptive learning rate.
        gamma: Discount factor per environment step.
        num_epochs: Passes over the samples of an iteration. None: the task's.
        max_iterations: Number of training iterations.
        save_interval: Iterations between checkpoints.
        physics_steps: Decimation, less than the task's; the physics timestep grows accordingly. None:
            the task's.
        simple_contacts: Use pyramidal friction cones, without torsional and rolling friction.
        unpushed_samples: Environment steps, summed over environments, until the pushes of the event
            `push_robot` grow from zero to their configured range. None: full pushes from the start.
        mirror: Symmetry augmentation function, as `module:function`, such as
            `mjlab.tasks.velocity.symmetry:mirror_left_right`. None: no mirror images.
    """

    # Functions import modules, because registering a task must not import torch.
    def set_policy(
        env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg
    ) -> RslRlBaseRunnerCfg | None:
        from mjlab.rl.config import gaussian_distribution

        rl_cfg.actor.hidden_dims = rl_cfg.critic.hidden_dims = hidden_dims
        if init_std is not None:
            rl_cfg.actor.distribution_cfg = gaussian_distribution(init_std)
        rl_cfg.num_steps_per_env, rl_cfg.max_iterations = num_steps_per_env, max_iterations
        rl_cfg.save_interval = save_interval
        algorithm = rl_cfg.algorithm
        algorithm.entropy_coef, algorithm.desired_kl = entropy_coef, desired_kl
        algorithm.gamma = gamma
        if num_epochs is not None:
            algorithm.num_learning_epochs = num_epochs
        if mirror is not None:
            algorithm.symmetry_cfg = {
                "data_augmentation_func": mirror,
                "use_data_augmentation": True,
            }
        return None if policy is None else policy(env_cfg, rl_cfg)

    def ease(
        env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlBaseRunnerCfg
    ) -> RslRlBaseRunnerCfg | None:
        from mjlab.tasks.easing import coarsen_physics, ease_pushes, simplify_contacts

        env_cfg.scene.num_envs = num_envs
        if physics_steps is not None:
            coarsen_physics(env_cfg, physics_steps)
        if simple_contacts:
            simplify_contacts(env_cfg)
        if unpushed_samples is not None:
            # Curricula count steps of the vectorized environment.
            ease_pushes(env_cfg, unpushed_samples // num_envs)
        return None if easing is None else easing(env_cfg, rl_cfg)

    return Profile(set_policy, ease)
