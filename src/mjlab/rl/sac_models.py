"""Networks of the off-policy learner: squashed Gaussian policy, twin Q critics.

Layer normalization (Ba et al., arXiv 1607.06450) stabilizes critics that learn from their own
predictions. A critic predicts the distribution of the return over fixed atoms and is trained by
cross-entropy instead of squared errors (Bellemare et al., arXiv 1707.06887; Farebrother et al.,
arXiv 2403.03950).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import Distribution
from rsl_rl.utils import resolve_nn_activation
from tensordict import TensorDict
from torch import nn

_LOG_2PI = math.log(2.0 * math.pi)


class SquashedGaussian(Distribution):
    """Distribution of bounded actions b tanh(u), of a Gaussian variable u and bounds b.

    The network outputs mean and standard deviation of u. With the change of variables, the share
    a = tanh(u) of the bounds has log p(a) = log N(u; mean, std) - sum_i log(1 - tanh(u_i)^2) (Haarnoja
    et al., arXiv 1801.01290, appendix C). `std` and `entropy` are those of u.
    """

    bounds: torch.Tensor

    def __init__(
        self,
        output_dim: int,
        init_std: float = 0.15,
        log_std_range: Sequence[float] = (-5.0, 0.0),
        bounds: Sequence[float] | None = None,
    ) -> None:
        """Set up the distribution.

        Args:
            output_dim: Number of actions.
            init_std: Initial standard deviation of u.
            log_std_range: Range (low, high) of the logarithm of the standard deviation.
            bounds: Bounds b of the actions, (A,). None: 1.

        Raises:
            ValueError: `init_std` is not within the range, or `bounds` are not one positive number per action.
        """
        super().__init__(output_dim)
        self._low, self._high = map(float, log_std_range)
        if not self._low < math.log(init_std) < self._high:
            raise ValueError(
                f"SquashedGaussian init_std: expected a number between {math.exp(self._low):.3g} and "
                f"{math.exp(self._high):.3g} (log_std_range {tuple(log_std_range)}), got {init_std}."
            )
        self._init_std = init_std
        self._mean = self._log_std = torch.zeros(0)
        values = [1.0] * output_dim if bounds is None else list(bounds)
        if len(values) != output_dim or not all(0.0 < value < math.inf for value in values):
            raise ValueError(
                f"SquashedGaussian bounds: expected {output_dim} positive numbers, got {values}."
            )
        self.register_buffer("bounds", torch.tensor(values, dtype=torch.float32))

    def _load_from_state_dict(
        self, state_dict: dict, prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        # Actions of checkpoints without bounds are in (-1, 1).
        state_dict.setdefault(f"{prefix}bounds", torch.ones_like(self.bounds))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    @property
    def input_dim(self) -> int:
        return 2 * self.output_dim

    def init_mlp_weights(self, mlp: nn.Module) -> None:
        """Initialize to zero mean for any observation (Seo et al., arXiv 2512.01996)."""
        last = [layer for layer in mlp.modules() if isinstance(layer, nn.Linear)][-1]
        share = (math.log(self._init_std) - self._low) / (self._high - self._low)
        nn.init.zeros_(last.weight)
        with torch.no_grad():
            last.bias[: self.output_dim] = 0.0
            last.bias[self.output_dim :] = math.atanh(2.0 * share - 1.0)

    def update(self, mlp_output: torch.Tensor) -> None:
        self._mean, raw = mlp_output.float().chunk(2, dim=-1)
        # A smooth bound, because a clamped value has zero gradient.
        share = 0.5 * (torch.tanh(raw) + 1.0)
        self._log_std = self._low + (self._high - self._low) * share

    def sample(self) -> torch.Tensor:
        return self.bounds * self.share_of(torch.randn_like(self._mean))

    def share_of(self, noise: torch.Tensor) -> torch.Tensor:
        """Return the share of the bounds (N, A) for standard normal `noise` (N, A)."""
        return torch.tanh(self._mean + self._log_std.exp() * noise)

    def share_and_log_prob(self, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the share of the bounds (N, A) for `noise` (N, A) and its log-probability (N,)."""
        u = self._mean + self._log_std.exp() * noise
        normal = -0.5 * (noise.square() + _LOG_2PI) - self._log_std
        # log(1 - tanh(u)^2), in a form that does not underflow.
        jacobian = 2.0 * (math.log(2.0) - u - nn.functional.softplus(-2.0 * u))
        return torch.tanh(u), (normal - jacobian).sum(dim=-1)

    def deterministic_output(self, mlp_output: torch.Tensor) -> torch.Tensor:
        return self.bounds * torch.tanh(mlp_output[..., : self.output_dim])

    def as_deterministic_output_module(self) -> nn.Module:
        return _BoundedMean(self.output_dim, self.bounds)

    @property
    def mean(self) -> torch.Tensor:
        return self.bounds * torch.tanh(self._mean)

    @property
    def std(self) -> torch.Tensor:
        return self._log_std.exp()

    @property
    def entropy(self) -> torch.Tensor:
        return (0.5 * (_LOG_2PI + 1.0) + self._log_std).sum(dim=-1)

    @property
    def params(self) -> tuple[torch.Tensor, ...]:
        return (self._mean, self.std)


class _BoundedMean(nn.Module):
    _bounds: torch.Tensor

    def __init__(self, num_actions: int, bounds: torch.Tensor) -> None:
        super().__init__()
        self._num_actions = num_actions
        self.register_buffer("_bounds", bounds)

    def forward(self, mlp_output: torch.Tensor) -> torch.Tensor:
        return self._bounds * torch.tanh(mlp_output[..., : self._num_actions])


def normalized_mlp(
    input_dim: int, output_dim: int, hidden_dims: Sequence[int], activation: str
) -> nn.Sequential:
    """Return a multilayer perceptron with layer normalization before each activation."""
    layers: list[nn.Module] = []
    for width in hidden_dims:
        layers += [nn.Linear(input_dim, width), nn.LayerNorm(width)]
        layers.append(resolve_nn_activation(activation))
        input_dim = width
    return nn.Sequential(*layers, nn.Linear(input_dim, output_dim))


class SacActorModel(MLPModel):
    """rsl_rl's policy network with layer normalization."""

    distribution: SquashedGaussian  # ty: ignore[incompatible-mutable-override]

    def __init__(self, *args: Any, hidden_dims: Sequence[int], activation: str, **kwargs: Any):
        """Build with the arguments of rsl_rl's `MLPModel`.

        Raises:
            ValueError: the distribution is not a `SquashedGaussian`.
        """
        super().__init__(*args, hidden_dims=tuple(hidden_dims), activation=activation, **kwargs)
        if not isinstance(self.distribution, SquashedGaussian):
            raise ValueError(
                f"SAC distribution_cfg: expected a SquashedGaussian, got {self.distribution}."
            )
        inputs, outputs = self._get_latent_dim(), self.distribution.input_dim
        self.mlp = normalized_mlp(inputs, outputs, hidden_dims, activation)
        self.distribution.init_mlp_weights(self.mlp)


class TwinCriticModel(MLPModel):
    """Two critics that predict the distribution of the return for a state and an action.

    The distribution is over `num_atoms` values, evenly spaced over `value_range`.
    """

    atoms: torch.Tensor

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        num_actions: int,
        *,
        num_atoms: int,
        value_range: tuple[float, float],
        hidden_dims: Sequence[int],
        activation: str,
        obs_normalization: bool = False,
    ) -> None:
        """Build with the observations, as rsl_rl's `MLPModel`.

        Raises:
            ValueError: `value_range` is empty.
        """
        super().__init__(obs, obs_groups, obs_set, 1, (1,), activation, obs_normalization)
        low, high = value_range
        if not low < high:
            raise ValueError(f"SAC value_range: expected low < high, got {value_range}.")
        del self.mlp
        input_dim = self._get_latent_dim() + num_actions
        self.critics = nn.ModuleList(
            normalized_mlp(input_dim, num_atoms, hidden_dims, activation) for _ in range(2)
        )
        self.register_buffer("atoms", torch.linspace(low, high, num_atoms), persistent=False)

    def logits(self, latent: torch.Tensor, actions: torch.Tensor) -> list[torch.Tensor]:
        """Return the logits (N, atoms) of each critic for `latent` observations (N, size)."""
        inputs = torch.cat([latent, actions], dim=-1)
        return [critic(inputs).float() for critic in self.critics]

    def values(self, latent: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Return the expected return of each critic, (2, N)."""
        probabilities = torch.softmax(torch.stack(self.logits(latent, actions)), dim=-1)
        # Not a matrix product, which mixed precision would round to three digits.
        return (probabilities * self.atoms).sum(dim=-1)

    def distribution_of(self, returns: torch.Tensor, spread: float = 0.75) -> torch.Tensor:
        """Return probabilities (N, atoms) with mean `returns` (N,), for cross-entropy.

        A Gaussian around the return, with standard deviation `spread` times the atom spacing; each
        atom has the mass between its neighboring midpoints (HL-Gauss, Farebrother et al., arXiv
        2403.03950). Returns are clamped to the range.
        """
        atoms = self.atoms
        distance = atoms[1] - atoms[0]
        edges = torch.cat([atoms - 0.5 * distance, atoms[-1:] + 0.5 * distance])
        returns = returns.clamp(atoms[0], atoms[-1])
        scale = 1.0 / (math.sqrt(2.0) * spread * distance)
        cumulative = torch.erf((edges - returns[:, None]) * scale)
        mass = cumulative.diff(dim=-1)
        return mass / mass.sum(dim=-1, keepdim=True)
