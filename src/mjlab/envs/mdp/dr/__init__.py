"""Domain randomization: event terms that vary model fields between environments.

Use these functions in an `EventTermCfg`: the model fields they write are expanded to per-environment
copies, and derived constants are recomputed.
"""

from __future__ import annotations

from mjlab.compat import older_names
from mjlab.envs.mdp.dr import (
    _types,
    actuator,
    body,
    camera,
    geom,
    joint,
    light,
    material,
    pair,
    site,
    tendon,
)
from mjlab.envs.mdp.dr._types import Distribution, Operation
from mjlab.envs.mdp.dr.actuator import *  # noqa: F403
from mjlab.envs.mdp.dr.body import *  # noqa: F403
from mjlab.envs.mdp.dr.camera import *  # noqa: F403
from mjlab.envs.mdp.dr.geom import *  # noqa: F403
from mjlab.envs.mdp.dr.joint import *  # noqa: F403
from mjlab.envs.mdp.dr.light import *  # noqa: F403
from mjlab.envs.mdp.dr.material import *  # noqa: F403
from mjlab.envs.mdp.dr.pair import *  # noqa: F403
from mjlab.envs.mdp.dr.site import *  # noqa: F403
from mjlab.envs.mdp.dr.tendon import *  # noqa: F403

__all__ = ["Distribution", "Operation"]
for _home in (actuator, body, camera, geom, joint, light, material, pair, site, tendon):
    __all__ += _home.__all__

# Operations and distributions as objects, not in `__all__`: `abs` is also a builtin.
abs, add, scale = _types.ABS, _types.ADD, _types.SCALE
uniform, log_uniform, gaussian = _types.UNIFORM, _types.LOG_UNIFORM, _types.GAUSSIAN

__getattr__ = older_names(__name__)
