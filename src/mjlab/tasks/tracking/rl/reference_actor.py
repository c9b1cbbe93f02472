"""Actor initialized as a position controller on the reference motion."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import torch
from rsl_rl.models import MLPModel
from torch import nn

from mjlab.envs import mdp
from mjlab.tasks.tracking.mdp.commands import MotionCommand

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

_OUTPUT_SCALE = 0.01


class ReferenceActor(MLPModel):
    """rsl_rl's `MLPModel` plus the action that targets the reference pose.

    The policy starts as a position controller on the reference and learns a residual, mainly to
    balance. Observations, actions and exports are those of the plain model. The motion tracking
    runner assigns actions to joints with `follow`.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Build the model; the arguments are those of rsl_rl's `MLPModel`.

        Raises:
            ValueError: the distribution needs more than one network output per action.
        """
        super().__init__(*args, **kwargs)
        distribution = self.distribution
        if distribution is not None and distribution.input_dim != distribution.output_dim:
            raise ValueError(
                "ReferenceActor distribution: expected one network output per action, got "
                f"{type(distribution).__name__} with {distribution.input_dim} outputs for "
                f"{distribution.output_dim} actions; use 'GaussianDistribution' (mean only) or "
                "class_name='MLPModel'."
            )
        self.mlp: nn.Module = _WithReference(self.mlp, self.obs_normalizer, self.obs_dim)

    @property
    def with_reference(self) -> _WithReference:
        """Network with reference term, stored as `mlp`."""
        return cast("_WithReference", self.mlp)

    def follow(self, env: ManagerBasedRlEnv, command: MotionCommand) -> None:
        """Set the reference term from the actions of `env` and the joints of `command`.

        Raises:
            ValueError: the actor does not observe the unscaled command, or the actions are not a
                single `JointPositionAction`.
        """
        begin = _command_offset(env, self.obs_groups, command)
        names = command.robot.joint_names
        manager = env.action_manager
        terms = [manager.get_term(name) for name in manager.active_terms]
        if len(terms) != 1 or not isinstance(terms[0], mdp.JointPositionAction):
            raise ValueError(
                "ReferenceActor actions: expected one JointPositionAction, got "
                f"{[type(term).__name__ for term in terms]}; use class_name='MLPModel'."
            )
        term = terms[0]
        weight, bias = self.with_reference.weight, self.with_reference.bias
        device, indices = weight.device, [names.index(name) for name in term.target_names]
        columns = begin + torch.tensor(indices, device=device)
        rows = torch.arange(len(indices), device=device)
        # Scale and offset may be scalars, and on a different device than the networks.
        shape = (env.num_envs, len(indices))
        scale = torch.as_tensor(term.scale, device=device).expand(shape)[0]
        offset = torch.as_tensor(term.offset, device=device).expand(shape)[0]
        with torch.no_grad():
            weight[rows, columns] = 1.0 / scale
            bias.copy_(-offset / scale)


class _WithReference(nn.Module):
    """Sum of a network of normalized observations and a linear map of unnormalized observations."""

    weight: torch.Tensor
    bias: torch.Tensor
    normalizer: Any

    def __init__(self, mlp: Any, normalizer: nn.Module, num_observations: int) -> None:
        super().__init__()
        # The model's normalizer is also registered here, because exports copy this module alone and
        # move it to other devices.
        self.mlp, self.normalizer = mlp, normalizer
        last = [layer for layer in mlp if isinstance(layer, nn.Linear)][-1]
        with torch.no_grad():
            last.weight.mul_(_OUTPUT_SCALE)
            last.bias.zero_()
        self.register_buffer("weight", torch.zeros(last.out_features, num_observations))
        self.register_buffer("bias", torch.zeros(last.out_features))

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        """Map normalized observations (N, observations) to actions (N, actions)."""
        raw = latent
        if not isinstance(self.normalizer, nn.Identity):
            raw = latent * (self.normalizer._std + self.normalizer.eps) + self.normalizer._mean
        return self.mlp(latent) + nn.functional.linear(raw, self.weight, self.bias)


def _command_offset(env: ManagerBasedRlEnv, groups: list[str], command: MotionCommand) -> int:
    """Return the index of the first reference joint position in the actor's observations."""
    manager, offset = env.observation_manager, 0
    for group in groups:
        shapes = manager.group_obs_term_dim[group]
        for name, shape in zip(manager.active_terms[group], shapes, strict=True):
            cfg = env.cfg.observations[group].terms[name]
            if cfg.func is mdp.generated_commands and shape == command.command.shape[1:]:
                found = env.command_manager.get_term(cfg.params["command_name"])
                if found is command and cfg.scale is None and cfg.clip is None:
                    return offset
            offset += shape[0]
    raise ValueError(
        "ReferenceActor observations: expected the motion command as `generated_commands` without "
        f"scale, clip and history, got {[manager.active_terms[group] for group in groups]}; add it, "
        "or use class_name='MLPModel'."
    )
