"""Runs of training and their checkpoints: read, compare, choose."""

from mjlab.runs.checkpoint import Checkpoint as Checkpoint
from mjlab.runs.run import Run as Run
from mjlab.runs.run import newest_run as newest_run
from mjlab.runs.run import resolve_checkpoint as resolve_checkpoint
from mjlab.runs.run import runs_in as runs_in
