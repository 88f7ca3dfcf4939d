"""Damped Gauss-Newton steps for N photos that couple only through K shared variables: a Schur complement.

A [K,K], B [N,K,P] and C [N,P,P] are the blocks of the matrix, a [K] and c [N,P] the right sides.
"""

from __future__ import annotations

import torch
from torch import Tensor


def shared_steps(A: Tensor, B: Tensor, C: Tensor, a: Tensor, c: Tensor, damping: float) -> tuple[Tensor, Tensor]:
    """Solve for the shared step [K] and the photos' steps [N,P]."""
    C = C + torch.diag_embed(damping * C.diagonal(dim1=-2, dim2=-1) + 1e-9)
    A = A + torch.diag(damping * A.diagonal())
    factor = torch.linalg.cholesky(C)
    eliminated = torch.cholesky_solve(torch.cat((B.mT, c[..., None]), -1), factor)
    reduced = A - (B @ eliminated[..., :-1]).sum(0)
    right = a - (B @ eliminated[..., -1:]).sum(0)[:, 0]
    shared = -torch.linalg.solve(reduced, right)
    return shared, -(eliminated[..., -1] + eliminated[..., :-1] @ shared)


def own_steps(A: Tensor, B: Tensor, C: Tensor, a: Tensor, c: Tensor, damping: float) -> tuple[Tensor, Tensor]:
    """The photos' steps [N,P] where nothing is shared; the shared step [K] is 0."""
    C = C + torch.diag_embed(damping * C.diagonal(dim1=-2, dim2=-1) + 1e-9)
    return torch.zeros_like(a), -torch.cholesky_solve(c[..., None], torch.linalg.cholesky(C))[..., 0]
