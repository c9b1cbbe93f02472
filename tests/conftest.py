"""Settings of the whole suite."""

from __future__ import annotations

import os

# Tests run several processes at a time; one thread each keeps them from fighting over the cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from hypothesis import settings

# A shared machine is slow at times, which says nothing about the code.
settings.register_profile("mjlab", deadline=None, derandomize=True)
settings.load_profile("mjlab")


@pytest.fixture(scope="session")
def gl() -> None:
    """Skip where this machine cannot render offscreen."""
    import mujoco

    from mjlab.viewer.errors import RenderingUnavailableError
    from mjlab.viewer.gl_context import open_renderer

    try:
        open_renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16).close()
    except RenderingUnavailableError as error:
        pytest.skip(str(error))
