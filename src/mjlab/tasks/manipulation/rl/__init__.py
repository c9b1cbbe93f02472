"""Runner of the manipulation tasks."""

from typing import TYPE_CHECKING

from mjlab.utils.lazy import lazy_names

if TYPE_CHECKING:
    from mjlab.tasks.manipulation.rl.runner import (
        ManipulationOnPolicyRunner as ManipulationOnPolicyRunner,
    )

# Imported on first use: learner configs, read for `--help`, do not need rsl_rl.
__getattr__ = lazy_names(
    __name__, {"ManipulationOnPolicyRunner": "mjlab.tasks.manipulation.rl.runner"}
)
