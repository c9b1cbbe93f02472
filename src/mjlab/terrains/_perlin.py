"""Fractal gradient noise."""

from __future__ import annotations

import numpy as np

# Gradients by the last two bits of a hash: x + y, x - y, -x + y, -x - y.
_SIGNS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])


def fractal_noise(
    shape: tuple[int, int],
    frequency: float,
    octaves: int,
    persistence: float,
    lacunarity: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return (rows, cols) noise, stretched to run from 0 to 1; zeros if there is none.

    Octave k adds gradient noise (K. Perlin, "Improving noise", SIGGRAPH 2002) with
    `frequency * lacunarity^k` cells along each side and the weight `persistence^k`.

    Args:
        shape: Number of rows and columns.
        frequency: Cells of the first octave along each side.
        octaves: Number of octaves.
        persistence: How much weaker each octave is than the one before.
        lacunarity: How much finer each octave is than the one before.
        rng: Draws the permutation of the lattice's gradients.
    """
    permutation = np.tile(rng.permutation(256), 2)
    total, weights = np.zeros(shape), 0.0
    for octave in range(octaves):
        cells, weight = frequency * lacunarity**octave, persistence**octave
        rows, cols = (np.arange(count) * cells / count for count in shape)
        total += weight * _gradient_noise(rows[:, None], cols[None, :], permutation)
        weights += weight
    total /= weights
    low, span = total.min(), np.ptp(total)
    return (total - low) / span if span > 0.0 else np.zeros(shape)


def _gradient_noise(x: np.ndarray, y: np.ndarray, permutation: np.ndarray) -> np.ndarray:
    """Return noise at lattice coordinates x, (n, 1), and y, (1, m), from a doubled permutation."""
    x_cell, y_cell = np.floor(x).astype(int), np.floor(y).astype(int)
    x_in, y_in = x - x_cell, y - y_cell
    x_cell, y_cell = x_cell % 256, y_cell % 256
    corners = [
        [
            _slope(permutation[permutation[x_cell + i] + y_cell + j], x_in - i, y_in - j)
            for j in (0, 1)
        ]
        for i in (0, 1)
    ]
    u, v = _fade(x_in), _fade(y_in)
    low, high = (near + v * (far - near) for near, far in corners)
    return low + u * (high - low)


def _slope(hashes: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    signs = _SIGNS[hashes % 4]
    return signs[..., 0] * x + signs[..., 1] * y


def _fade(t: np.ndarray) -> np.ndarray:
    return t**3 * (t * (t * 6.0 - 15.0) + 10.0)
