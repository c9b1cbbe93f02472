"""An actor that follows the reference before it has learned anything."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from mjlab.envs import mdp
from mjlab.rl.rsl import MLPModel
from mjlab.tasks.tracking.mdp.motion_command import MotionCommand

_NEARLY_NOTHING = 0.01


class ReferenceActor(MLPModel):
    """rsl_rl's `MLPModel`, whose output is added to the action that asks for the reference's pose.

    So a policy begins as a position controller on the reference, and learns what that lacks, which is
    to keep its balance. It reads the same observations and gives the same actions as the plain model,
    and is exported like it. The runner of motion tracking says which action asks for which joint.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Take the arguments of rsl_rl's `MLPModel`."""
        super().__init__(*args, **kwargs)
        self.with_reference = _WithReference(self.mlp, self.obs_normalizer, self.obs_dim)
        self.mlp: nn.Module = self.with_reference

    def follow(self, env: Any, command: MotionCommand) -> None:
        """Take from `env` which action asks for which joint of `command`.

        Raises:
            ValueError: the actor does not observe the command as it is, or the actions are not one
                term of joint positions.
        """
        begin = _place_of_command(env, self.obs_groups, command)
        names = command.robot.joint_names
        term = _joint_positions(env)
        columns = [begin + names.index(name) for name in term.target_names]
        shape = (env.num_envs, len(columns))
        scale = torch.as_tensor(term.scale).expand(shape)[0]
        offset = torch.as_tensor(term.offset).expand(shape)[0]
        self.with_reference.weight[torch.arange(len(columns)), torch.tensor(columns)] = 1.0 / scale
        self.with_reference.bias.copy_(-offset / scale)


class _WithReference(nn.Module):
    """What a network makes of normalized observations, and a linear function of the plain ones."""

    weight: torch.Tensor
    bias: torch.Tensor
    normalizer: Any

    def __init__(self, mlp: Any, normalizer: nn.Module, num_observations: int) -> None:
        super().__init__()
        self.mlp, self.normalizer = mlp, normalizer
        last = [layer for layer in mlp if isinstance(layer, nn.Linear)][-1]
        with torch.no_grad():
            last.weight.mul_(_NEARLY_NOTHING)
            last.bias.zero_()
        self.register_buffer("weight", torch.zeros(last.out_features, num_observations))
        self.register_buffer("bias", torch.zeros(last.out_features))

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        """Map normalized observations (N, observations) to actions (N, actions)."""
        plain = latent
        if not isinstance(self.normalizer, nn.Identity):
            plain = latent * (self.normalizer._std + self.normalizer.eps) + self.normalizer._mean
        return self.mlp(latent) + nn.functional.linear(plain, self.weight, self.bias)


def _place_of_command(env: Any, groups: list[str], command: MotionCommand) -> int:
    """Return where in the actor's observations the reference's joint positions begin."""
    manager, place = env.observation_manager, 0
    for group in groups:
        shapes = manager.group_obs_term_dim[group]
        for name, shape in zip(manager.active_terms[group], shapes, strict=True):
            cfg = env.cfg.observations[group].terms[name]
            if cfg.func is mdp.generated_commands and shape == command.command.shape[1:]:
                found = env.command_manager.get_term(cfg.params["command_name"])
                if found is command and cfg.scale is None and cfg.clip is None:
                    return place
            place += shape[0]
    raise ValueError(
        "ReferenceActor needs the motion command among the actor's observations, as "
        "`generated_commands` without scale, clip and history; these are "
        f"{[manager.active_terms[group] for group in groups]}. Add it, or use class_name='MLPModel'."
    )


def _joint_positions(env: Any) -> mdp.JointPositionAction:
    manager = env.action_manager
    terms = [manager.get_term(name) for name in manager.active_terms]
    if len(terms) != 1 or not isinstance(terms[0], mdp.JointPositionAction):
        raise ValueError(
            "ReferenceActor needs one action term, of joint positions; there are "
            f"{[type(term).__name__ for term in terms]}. Use class_name='MLPModel'."
        )
    return terms[0]
