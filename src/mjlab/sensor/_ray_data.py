"""What a ray sensor has measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import torch

from mjlab.utils.lab_api.math import quat_from_matrix


@dataclass
class RayCastData:
    """What a ray sensor with F frames of n rays has measured; ray `f n + r` is ray r of frame f."""

    distances: torch.Tensor
    """(N, F n) metres; -1 for a miss."""
    normals_w: torch.Tensor
    """(N, F n, 3) unit surface normals in the world frame; 0 for a miss."""
    hit_pos_w: torch.Tensor
    """(N, F n, 3) world positions of what is hit; for a miss, where the ray starts."""
    pos_w: torch.Tensor
    """(N, 3) world position of the first frame."""
    quat_w: torch.Tensor
    """(N, 4) orientation of the first frame, not aligned."""
    frame_pos_w: torch.Tensor
    """(N, F, 3) world positions of the frames."""
    frame_quat_w: torch.Tensor
    """(N, F, 4) orientations of the frames, not aligned."""

    @classmethod
    def with_frames(cls, frame_mat: torch.Tensor, **fields: torch.Tensor) -> Self:
        """Return data whose quaternions are computed from `frame_mat` (N, F, 3, 3) when read.

        Few terms read them, and computing them takes longer than all the other fields together.
        """
        data = cls.__new__(cls)
        data.__dict__.update(fields, _frame_mat=frame_mat)
        return data

    def __getattr__(self, name: str) -> Any:
        # Only asked for what is not there yet.
        if name not in ("quat_w", "frame_quat_w") or "_frame_mat" not in self.__dict__:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        self.frame_quat_w = quat_from_matrix(self.__dict__["_frame_mat"])
        self.quat_w = self.frame_quat_w[:, 0]
        return self.__dict__[name]
