"""Runs of training and their checkpoints: read, compare, choose, act."""

from typing import TYPE_CHECKING

from mjlab.runs.checkpoint import Checkpoint as Checkpoint
from mjlab.runs.run import Run as Run
from mjlab.runs.run import newest_run as newest_run
from mjlab.runs.run import resolve_checkpoint as resolve_checkpoint
from mjlab.runs.run import runs_in as runs_in
from mjlab.utils.lazy import lazy_names

if TYPE_CHECKING:
    from mjlab.runs.policy import load_policy as load_policy
    from mjlab.runs.policy import make_env as make_env

# These build environments and networks; most uses only read folders.
__getattr__ = lazy_names(
    __name__, {"load_policy": "mjlab.runs.policy", "make_env": "mjlab.runs.policy"}
)
