"""Spaces and their batches."""

from __future__ import annotations

import math

from mjlab.utils.spaces import Box, Dict, Space, batch_space


def test_defaults():
    assert (Space().shape, Space().dtype) == ((), "float32")
    assert (Box().low, Box().high) == (-math.inf, math.inf)
    assert Dict().spaces == {}


def test_batches_add_a_leading_axis_everywhere():
    single = Dict(
        spaces={
            "actor": Box(shape=(3,), low=-1.0, high=(1.0, 2.0, 3.0)),
            "camera": Dict(spaces={"rgb": Box(shape=(4, 5, 3), dtype="uint8")}),
        }
    )
    batched = batch_space(single, 7)
    assert isinstance(batched, Dict)
    assert batched.shape == (7,)
    assert batched.spaces["actor"] == Box(shape=(7, 3), low=-1.0, high=(1.0, 2.0, 3.0))
    camera = batched.spaces["camera"]
    assert isinstance(camera, Dict)
    assert camera.shape == (7,)
    assert camera.spaces["rgb"] == Box(shape=(7, 4, 5, 3), dtype="uint8")
    assert single.spaces["actor"].shape == (3,)
