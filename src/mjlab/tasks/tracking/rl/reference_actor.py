"""An actor that follows the reference before it has learned anything."""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.models import MLPModel
from torch import nn

from mjlab.envs import mdp
from mjlab.tasks.tracking.mdp.commands import MotionCommand

_NEARLY_NOTHING = 0.01


class ReferenceActor(MLPModel):
    """rsl_rl's `MLPModel`, whose output is added to the action that asks for the reference's pose.

    So a policy begins as a position controller on the reference, and learns what that lacks, which is
    to keep its balance. It reads the same observations and gives the same actions as the plain model,
    and is exported like it. The runner of motion tracking says which action asks for which joint.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Take the arguments of rsl_rl's `MLPModel`.

        Raises:
            ValueError: the distribution takes more from the network than one number for each action.
        """
        super().__init__(*args, **kwargs)
        wanted = self.distribution
        if wanted is not None and wanted.input_dim != wanted.output_dim:
            raise ValueError(
                f"ReferenceActor cannot have the distribution {type(wanted).__name__}, which takes "
                f"{wanted.input_dim} numbers from the network for {wanted.output_dim} actions. Use "
                "'GaussianDistribution', which takes the mean alone, or class_name='MLPModel'."
            )
        self.mlp: nn.Module = _WithReference(self.mlp, self.obs_normalizer, self.obs_dim)

    @property
    def with_reference(self) -> _WithReference:
        """The network and what is added to its output; it stands where `MLPModel` has the network."""
        network: Any = self.mlp
        return network

    def follow(self, env: Any, command: MotionCommand) -> None:
        """Take from `env` which action asks for which joint of `command`.

        Raises:
            ValueError: the actor does not observe the command as it is, or the actions are not one
                term of joint positions.
        """
        begin = _place_of_command(env, self.obs_groups, command)
        names = command.robot.joint_names
        term = _joint_positions(env)
        weight, bias = self.with_reference.weight, self.with_reference.bias
        device, indices = weight.device, [names.index(name) for name in term.target_names]
        columns = begin + torch.tensor(indices, device=device)
        rows = torch.arange(len(indices), device=device)
        # Both may be single numbers, and the networks may be on another device than the term.
        shape = (env.num_envs, len(indices))
        scale = torch.as_tensor(term.scale, device=device).expand(shape)[0]
        offset = torch.as_tensor(term.offset, device=device).expand(shape)[0]
        with torch.no_grad():
            weight[rows, columns] = 1.0 / scale
            bias.copy_(-offset / scale)


class _WithReference(nn.Module):
    """What a network makes of normalized observations, and a linear function of the plain ones."""

    weight: torch.Tensor
    bias: torch.Tensor
    normalizer: Any

    def __init__(self, mlp: Any, normalizer: nn.Module, num_observations: int) -> None:
        super().__init__()
        # The normalizer is the model's. It is listed here too, so that a copy of this module alone,
        # which is what is exported, has it and moves it to other devices.
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
