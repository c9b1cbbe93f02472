"""Settings of the whole suite."""

from __future__ import annotations

import os

# Tests run several processes at a time; one thread each keeps them from fighting over the cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from hypothesis import settings

# A shared machine is slow at times, which says nothing about the code.
settings.register_profile("mjlab", deadline=None, derandomize=True)
settings.load_profile("mjlab")
