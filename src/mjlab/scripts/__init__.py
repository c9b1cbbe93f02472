"""Command lines. Each parses its arguments and wires objects together; none knows a task.

Commands can be run by `python -m mjlab.scripts.<name>` too.
"""

import os
import sys


def prepare_threads() -> None:
    """Let idle threads of torch sleep: spinning, they take the cores from the physics threads.

    Takes effect only before torch is loaded.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


# `python -m` names itself so while it looks for the module, whose imports may load torch.
if sys.argv[:1] == ["-m"]:
    prepare_threads()
