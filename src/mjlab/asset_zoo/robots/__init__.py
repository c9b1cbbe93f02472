"""Robot configs.

Names are imported on first use, so that a task loads only its robot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.utils.lazy import lazy_names

if TYPE_CHECKING:
    from mjlab.asset_zoo.robots.i2rt_yam.yam_constants import YAM_ACTION_SCALE as YAM_ACTION_SCALE
    from mjlab.asset_zoo.robots.i2rt_yam.yam_constants import (
        get_yam_robot_cfg as get_yam_robot_cfg,
    )
    from mjlab.asset_zoo.robots.unitree_g1.g1_constants import G1_ACTION_SCALE as G1_ACTION_SCALE
    from mjlab.asset_zoo.robots.unitree_g1.g1_constants import (
        get_g1_robot_cfg as get_g1_robot_cfg,
    )
    from mjlab.asset_zoo.robots.unitree_go1.go1_constants import (
        GO1_ACTION_SCALE as GO1_ACTION_SCALE,
    )
    from mjlab.asset_zoo.robots.unitree_go1.go1_constants import (
        get_go1_robot_cfg as get_go1_robot_cfg,
    )

_HOMES = {
    "G1_ACTION_SCALE": "mjlab.asset_zoo.robots.unitree_g1.g1_constants",
    "get_g1_robot_cfg": "mjlab.asset_zoo.robots.unitree_g1.g1_constants",
    "GO1_ACTION_SCALE": "mjlab.asset_zoo.robots.unitree_go1.go1_constants",
    "get_go1_robot_cfg": "mjlab.asset_zoo.robots.unitree_go1.go1_constants",
    "YAM_ACTION_SCALE": "mjlab.asset_zoo.robots.i2rt_yam.yam_constants",
    "get_yam_robot_cfg": "mjlab.asset_zoo.robots.i2rt_yam.yam_constants",
}

__all__ = sorted(_HOMES)

__getattr__ = lazy_names(__name__, _HOMES)
