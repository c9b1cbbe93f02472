"""Small regularized least-squares problems, one for each environment."""

from __future__ import annotations

import torch


def damped_least_squares(
    jacobian: torch.Tensor, error: torch.Tensor, stiffness: torch.Tensor, pull: torch.Tensor
) -> torch.Tensor:
    """Return x = (J'J + D)^-1 (J'e + b), with D a diagonal of positive numbers.

    It is computed as x = D^-1 (b + J'y) with (J D^-1 J' + I) y = e - J D^-1 b (the matrix inversion
    lemma). That system has the size of the task, not of the arm, its eigenvalues are at least 1,
    and for an arm that can move freely its condition does not depend on the damping, while that of
    J'J + D grows with its inverse square: in single precision that fails from a damping of about
    1e-3 downward. Singular poses still make it ill-conditioned, so it is solved in double
    precision, which costs no more time here.

    Args:
        jacobian: J, (N, m, n). error: e, (N, m). stiffness: D, (N, n). pull: b, (N, n).

    Returns (N, n), in the precision of `jacobian`.
    """
    j, e = jacobian.double(), error.double().unsqueeze(-1)
    d, b = stiffness.double().unsqueeze(-1), pull.double().unsqueeze(-1)
    scaled = j.mT / d
    system = j @ scaled
    system.diagonal(dim1=-2, dim2=-1).add_(1.0)
    # Without a check of the outcome, which would wait for a GPU: the matrix is positive definite.
    multiplier, _ = torch.linalg.solve_ex(system, e - j @ (b / d))
    return (b / d + scaled @ multiplier).squeeze(-1).to(jacobian.dtype)
