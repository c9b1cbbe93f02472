"""Image encoders with spatial softmax: positions of features instead of their activations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from rsl_rl.models import CNNModel
from rsl_rl.modules import CNN
from tensordict import TensorDict
from torch import nn

# Keys of a CNN config that rsl_rl's CNN does not accept.
_SPATIAL_SOFTMAX_KEYS = ("spatial_softmax", "spatial_softmax_temperature")


class SpatialSoftmax(nn.Module):
    """Expected position of each channel's activation.

    With w = softmax(x / temperature) over the cells of a channel, the output is (sum w * row,
    sum w * column), rows and columns running from -1 to 1 (a side of length 1 is at -1).
    """

    rows: torch.Tensor
    columns: torch.Tensor

    def __init__(self, height: int, width: int, temperature: float = 1.0) -> None:
        """Set up for feature maps of `height` x `width` cells."""
        super().__init__()
        self.temperature = temperature
        rows, columns = torch.meshgrid(
            torch.linspace(-1.0, 1.0, height), torch.linspace(-1.0, 1.0, width), indexing="ij"
        )
        self.register_buffer("rows", rows.reshape(-1))
        self.register_buffer("columns", columns.reshape(-1))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map features (B, C, H, W) to (B, 2C): row and column of channel 0, of channel 1, ..."""
        weights = torch.softmax(x.flatten(2) / self.temperature, dim=-1)
        row = (weights * self.rows).sum(-1)
        column = (weights * self.columns).sum(-1)
        return torch.stack((row, column), dim=-1).flatten(1)


class SpatialSoftmaxCNN(nn.Module):
    """rsl_rl's CNN without final pooling and flattening, followed by a spatial softmax."""

    def __init__(
        self,
        input_dim: tuple[int, int],
        input_channels: int,
        temperature: float = 1.0,
        **cnn_kwargs: Any,
    ) -> None:
        """Build for images of `input_dim` (height, width); `cnn_kwargs` go to rsl_rl's CNN."""
        super().__init__()
        cnn_kwargs = {**cnn_kwargs, "global_pool": "none", "flatten": False}
        cnn: Any = CNN(input_dim=input_dim, input_channels=input_channels, **cnn_kwargs)
        height, width = cnn.output_dim
        self.cnn = cnn
        self.spatial_softmax = SpatialSoftmax(height, width, temperature)
        self._output_dim = 2 * int(cnn.output_channels)

    @property
    def output_channels(self) -> None:
        """None: rsl_rl's marker of a flat output."""
        return None

    @property
    def output_dim(self) -> int:
        """Output size: two values per channel."""
        return self._output_dim

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map images (B, C, H, W) to (B, output_dim)."""
        return self.spatial_softmax(self.cnn(x))


class SpatialSoftmaxCNNModel(CNNModel):
    """rsl_rl's model for images and flat observations, with spatial softmax encoders."""

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        cnn_cfg: dict[str, dict] | dict[str, Any],
        cnns: nn.ModuleDict | None = None,
        hidden_dims: tuple[int] | list[int] = [256, 256, 256],  # noqa: B006
        activation: str = "elu",
        obs_normalization: bool = False,
        distribution_cfg: dict[str, Any] | None = None,
    ) -> None:
        """Build the model; arguments are those of rsl_rl's `CNNModel`.

        `cnn_cfg` is one config for all image groups, or one per group by name; besides the keys of
        rsl_rl's CNN it accepts `spatial_softmax_temperature`. `cnns` are shared encoders.

        Raises:
            ValueError: the names in `cnns` or `cnn_cfg` are not those of the image groups.
        """
        if cnns is None:
            self._get_obs_dim(obs, obs_groups, obs_set)
            settings = _cnn_cfg_by_group(cnn_cfg, self.obs_groups_2d)
            encoders: Any = {
                group: SpatialSoftmaxCNN(
                    input_dim=self.obs_dims_2d[index],
                    input_channels=self.obs_channels_2d[index],
                    temperature=settings[group].get("spatial_softmax_temperature", 1.0),
                    **{k: v for k, v in settings[group].items() if k not in _SPATIAL_SOFTMAX_KEYS},
                )
                for index, group in enumerate(self.obs_groups_2d)
            }
        else:
            encoders = cnns
        super().__init__(
            obs,
            obs_groups,
            obs_set,
            output_dim,
            hidden_dims=hidden_dims,
            activation=activation,
            obs_normalization=obs_normalization,
            distribution_cfg=distribution_cfg,
            cnns=encoders,
        )


def _cnn_cfg_by_group(
    cnn_cfg: Mapping[str, Any], groups: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Return the CNN config of each image group; a single config applies to all groups."""
    if not all(isinstance(value, dict) for value in cnn_cfg.values()):
        return {group: dict(cnn_cfg) for group in groups}
    if set(cnn_cfg) != set(groups):
        raise ValueError(
            f"cnn_cfg: expected a config per image group {sorted(groups)}, or one config for all, got "
            f"configs for {sorted(cnn_cfg)}."
        )
    return {group: dict(cnn_cfg[group]) for group in groups}
