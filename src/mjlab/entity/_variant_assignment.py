"""Which variant each environment gets."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

Assignment = dict[str, float] | Callable[[int], Sequence[int]] | None


def allocate_worlds(weights: tuple[float, ...], nworld: int) -> list[int]:
    """Return the variant of each of `nworld` environments, by weight, in contiguous blocks.

    Each variant gets its quota `w_i / sum(w) * nworld`, rounded down. What is left over goes to the
    largest remainders, of equal ones to the earlier variant.

    Raises:
        ValueError: a weight is negative or not finite, or all are zero.
    """
    bad = [weight for weight in weights if not (math.isfinite(weight) and weight >= 0.0)]
    total = sum(weights)
    if bad or not 0.0 < total < math.inf:
        raise ValueError(
            f"The weights of variants are {tuple(weights)}; they must be finite, none negative, "
            "and not all zero. A weight of 0 leaves a variant out."
        )
    quotas = [weight / total * nworld for weight in weights]
    # Quotas that are whole but for rounding, such as 3 * (1 / 3), count as whole.
    counts = [math.floor(quota + 1e-9) for quota in quotas]
    remainders = [quota - count for quota, count in zip(quotas, counts, strict=True)]
    order = sorted(range(len(weights)), key=lambda k: (-round(remainders[k], 9), k))
    for k in order[: nworld - sum(counts)]:
        counts[k] += 1
    return [k for k, count in enumerate(counts) for _ in range(count)]


def resolve_assignment(
    names: tuple[str, ...], assignment: Assignment
) -> tuple[float, ...] | Callable[[int], Sequence[int]]:
    """Return one weight for each variant, or the callable that assigns them.

    Raises:
        ValueError: `assignment` names a variant that does not exist, or its weights make no sense.
    """
    if assignment is not None and not isinstance(assignment, dict):
        return assignment
    given: dict[str, float] = {} if assignment is None else assignment
    unknown = [name for name in given if name not in names]
    if unknown:
        raise ValueError(
            f"VariantEntityCfg.assignment names the variants {unknown}, which do not exist. "
            f"There are: {list(names)}."
        )
    weights = tuple(float(given.get(name, 1.0)) for name in names)
    try:
        allocate_worlds(weights, 1)
    except ValueError as error:
        raise ValueError(f"VariantEntityCfg.assignment is {given}. {error}") from None
    return weights


def assign_worlds(
    assignment: tuple[float, ...] | Callable[[int], Sequence[int]],
    names: tuple[str, ...],
    nworld: int,
) -> np.ndarray:
    """Return the variant of each environment, (nworld,) int64.

    Raises:
        ValueError: a callable returns another number of indices, or one that no variant has.
    """
    if not callable(assignment):
        return np.array(allocate_worlds(assignment, nworld), dtype=np.int64)
    found = np.asarray(assignment(nworld))
    if found.shape != (nworld,) or found.dtype.kind not in "iu":
        raise ValueError(
            f"VariantEntityCfg.assignment was called with {nworld} and returned an array of shape "
            f"{found.shape} and type {found.dtype}; it must return {nworld} whole numbers, the "
            "index of each environment's variant."
        )
    outside = sorted({int(k) for k in found if not 0 <= k < len(names)})
    if outside:
        raise ValueError(
            f"VariantEntityCfg.assignment returned the indices {outside}; the variants "
            f"{list(names)} have the indices 0 to {len(names) - 1}."
        )
    return found.astype(np.int64)
