"""Batched buffers of recent values: a ring of frames, and a random delay on top of it."""

from mjlab.utils.buffers.circular_buffer import CircularBuffer as CircularBuffer
from mjlab.utils.buffers.delay_buffer import DelayBuffer as DelayBuffer
