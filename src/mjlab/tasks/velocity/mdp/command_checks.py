"""What a velocity command refuses when it is built."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.envs.mdp._checks import check_range

if TYPE_CHECKING:
    from mjlab.tasks.velocity.mdp.velocity_command import UniformVelocityCommandCfg

RANGES = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
"""The ranges that every velocity command has."""
_PROBABILITIES = (
    "rel_standing_envs",
    "rel_heading_envs",
    "rel_world_envs",
    "rel_forward_envs",
    "init_velocity_prob",
)


def check_command_cfg(cfg: UniformVelocityCommandCfg) -> None:
    """Raise `ValueError` for ranges, shares or a heading that make no sense."""
    for name in RANGES:
        check_range(f"ranges.{name}", getattr(cfg.ranges, name))
    if cfg.heading_command and cfg.ranges.heading is None:
        raise ValueError("heading_command is True, but ranges.heading is None. Give the range.")
    if not cfg.heading_command and cfg.ranges.heading is not None:
        raise ValueError(
            f"ranges.heading is {cfg.ranges.heading}, but heading_command is False, so that no "
            "heading is ever commanded. Set heading_command=True, or ranges.heading=None."
        )
    if cfg.ranges.heading is not None:
        check_range("ranges.heading", cfg.ranges.heading)
    for name in _PROBABILITIES:
        if not 0.0 <= getattr(cfg, name) <= 1.0:
            raise ValueError(f"{name} is {getattr(cfg, name)!r}; a share is between 0 and 1.")
