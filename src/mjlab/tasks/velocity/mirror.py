"""Left and right of a robot: which joints and feet are mirror images of which, and with what sign.

The mirror is the plane of x and z of the robot's root. In it directions change the sign of y, and
axes of rotation those of x and z.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import torch

DIRECTION = (1.0, -1.0, 1.0)
ROTATION = (-1.0, 1.0, -1.0)

_SIDES = {"left": "right", "FL": "FR", "RL": "RR"}
_OTHER_SIDE = _SIDES | {right: left for left, right in _SIDES.items()}
# By how much partners may differ: axes (unit vectors), default positions (rad), places (m).
_AXIS_TOLERANCE, _POSE_TOLERANCE, PLACE_TOLERANCE = 1e-4, 1e-3, 5e-3
WITHOUT = "To learn without mirror images, set agent.algorithm.symmetry_cfg to None."


class Coupling(NamedTuple):
    """A share of one number in the mirror image of another."""

    target: int
    """Number of the image."""
    source: int
    """Number that is read."""
    factor: float


class Mirror:
    """Mirror image of a vector of numbers.

    Number i is `signs[i]` times number `sources[i]`, and what the couplings of i add.
    """

    def __init__(
        self, sources: Sequence[int], signs: Sequence[float], couplings: Sequence[Coupling] = ()
    ) -> None:
        """Take indices and signs, of one length."""
        self.sources = torch.tensor(sources)
        self.signs = torch.tensor(signs, dtype=torch.float32)
        self._targets = torch.tensor([coupling.target for coupling in couplings]).long()
        self._read = torch.tensor([coupling.source for coupling in couplings]).long()
        self._factors = torch.tensor(
            [coupling.factor for coupling in couplings], dtype=torch.float32
        )

    def __len__(self) -> int:
        return len(self.signs)

    def __call__(self, values: torch.Tensor) -> torch.Tensor:
        """Return the mirror image of `values` (N, numbers)."""
        if self.signs.device != values.device:
            for name in ("sources", "signs", "_targets", "_read", "_factors"):
                setattr(self, name, getattr(self, name).to(values.device))
        image = values[:, self.sources] * self.signs
        if len(self._targets):
            image.index_add_(1, self._targets, values[:, self._read] * self._factors)
        return image

    @staticmethod
    def joined(mirrors: Sequence[Mirror], couplings: Sequence[Coupling] = ()) -> Mirror:
        """Return the mirror of vectors that stand one behind the other, coupled as given."""
        sources: list[int] = []
        signs: list[float] = []
        for mirror in mirrors:
            sources += [len(signs) + source for source in mirror.sources.tolist()]
            signs += mirror.signs.tolist()
        return Mirror(sources, signs, couplings)


def partners(names: Sequence[str]) -> list[int]:
    """Return the index of what is on the other side, for each name; what is in the middle stays.

    Raises:
        ValueError: the other side of a name is not among them.
    """
    others = [other_side(name) for name in names]
    missing = sorted(set(others) - set(names))
    if missing:
        raise ValueError(
            f"mirror_left_right finds no {', '.join(missing)} among {', '.join(names)}. It knows the "
            f"sides by these parts of names: {', '.join(_OTHER_SIDE)}. {WITHOUT}"
        )
    return [list(names).index(other) for other in others]


def other_side(name: str) -> str:
    """Return the name of what is on the other side; the same for what is in the middle."""
    return "_".join(_OTHER_SIDE.get(part, part) for part in name.split("_"))


def mirror_of_joints(model: mujoco.MjModel, robot: Any) -> Mirror:
    """Return the mirror of the joints of `robot`, an entity, in its order.

    Joints belong together by their names. A joint turns, or slides, the other way in the mirror
    where the mirror image of its axis points against its partner's.

    Raises:
        ValueError: a joint is not the mirror image of its partner.
    """
    names = robot.joint_names
    pairs = partners(names)
    axes, places, is_slide = _joint_frames(model, robot)
    reflect = torch.where(
        is_slide[:, None],
        torch.tensor(DIRECTION, dtype=torch.float32),
        torch.tensor(ROTATION, dtype=torch.float32),
    )
    signs = ((axes * reflect)[pairs] * axes).sum(dim=1)
    pose = robot.data.default_joint_pos[0].cpu()
    apart = (places[pairs] * torch.tensor(DIRECTION, dtype=torch.float32) - places).norm(dim=1)
    for i, partner in enumerate(pairs):
        if (
            abs(abs(signs[i]) - 1) > _AXIS_TOLERANCE
            or apart[i] > PLACE_TOLERANCE
            or abs(pose[i] - signs[i] * pose[partner]) > _POSE_TOLERANCE
        ):
            raise ValueError(
                f"Joint {names[i]!r} is not the mirror image of {names[partner]!r}: axes "
                f"{_shown(axes[i])} and {_shown(axes[partner])}, places {_shown(places[i])} and "
                f"{_shown(places[partner])}, default positions {pose[i]:.4g} and {pose[partner]:.4g}. "
                "Joints belong together by these parts of their names: "
                f"{', '.join(_OTHER_SIDE)}. {WITHOUT}"
            )
    return Mirror(pairs, signs.round().tolist())


def _joint_frames(
    model: mujoco.MjModel, robot: Any
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return axes and places (joints, 3) in the frame of the root at `qpos0`, and which slide."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    root = int(robot.indexing.root_body_id)
    ids = robot.indexing.joint_ids.tolist()
    to_root = data.xmat[root].reshape(3, 3)
    axes = data.xaxis[ids] @ to_root
    places = (data.xanchor[ids] - data.xpos[root]) @ to_root
    is_slide = model.jnt_type[ids] == mujoco.mjtJoint.mjJNT_SLIDE
    return (
        torch.tensor(axes, dtype=torch.float32),
        torch.tensor(places, dtype=torch.float32),
        torch.tensor(is_slide),
    )


def _shown(vector: torch.Tensor) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in vector.tolist()) + ")"
