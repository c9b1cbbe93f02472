"""Parts that the commands of `mjlab.scripts` share: entry point, flags, help, display of training."""

import os
import sys

from mjlab.utils.signals import end_by_interrupt


def prepare_threads() -> None:
    """Let idle torch threads sleep: spinning threads take cores from the physics threads.

    Takes effect only before torch is loaded.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


LOADS_AS_MODULE = False
"""Ctrl-C ends the process until `run_command`: a module of mjlab is being loaded by `python -m`."""

# argv[0] is "-m" while `python -m` locates the module, whose imports may load torch.
if sys.argv[:1] == ["-m"]:
    prepare_threads()
    # Without the words after it, the last is the module. Other programs keep KeyboardInterrupt.
    if sys.orig_argv[-len(sys.argv) :][0].removeprefix("-m").split(".")[0] == "mjlab":
        LOADS_AS_MODULE = end_by_interrupt(True)
