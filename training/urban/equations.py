"""Paper 2's printed eq. (5), and its information shares beta, checked by numbers."""

from __future__ import annotations

import torch
from torch import Tensor

from difffilter.reports.report import Report

#: Measurement variances of the two systems, m^2, and the time step, s.
NOISE = (9.0, 25.0)
DT = 0.2
STEPS = 200


def judge_equations(report: Report) -> None:
    """Two claims."""
    prior, noise = 25.0, NOISE[0]
    gain = prior / (prior + noise)
    updated, printed = (1.0 - gain) * prior, 1.0 / (prior - 1.0 / noise)
    report.claim(
        "paper 2, eq. (5): the updated covariance as printed, (P - C^T R^-1 C)^-1, is the Kalman "
        "filter's",
        abs(printed / updated - 1.0) < 1e-9,
        {"prior (m^2)": prior, "R (m^2)": noise, "as printed": printed,
         "(P^-1 + C^T R^-1 C)^-1": 1.0 / (1.0 / prior + 1.0 / noise), "Kalman filter": updated},
    )  # fmt: skip
    generator = torch.Generator().manual_seed(0)
    z = torch.cumsum(torch.randn(STEPS, 2, generator=generator, dtype=torch.float64), 0)
    equal = _federated(z, torch.full((STEPS,), 0.5, dtype=torch.float64))
    random = 0.02 + 0.96 * torch.rand(STEPS, generator=generator, dtype=torch.float64)
    largest = float((_federated(z, random) - equal).abs().max())
    report.claim(
        "paper 2, as printed: credibility that sets the information shares beta changes the fused "
        "estimate",
        largest > 1e-6,
        {"largest change by random shares (m, m/s)": f"{largest:.1e}",
         "why": "the sum of beta_i P^-1 + C^T R_i^-1 C does not depend on beta"},
    )  # fmt: skip


def _federated(z: Tensor, shares: Tensor) -> Tensor:
    """(T, 2), fusion and reset at every step; system 1 has the share, system 2 the rest."""
    motion = torch.tensor([[1.0, DT], [0.0, 1.0]], dtype=torch.float64)
    process = torch.tensor([[DT**3 / 3.0, DT**2 / 2.0], [DT**2 / 2.0, DT]], dtype=torch.float64)
    row = torch.tensor([1.0, 0.0], dtype=torch.float64)
    mean = torch.zeros(2, dtype=torch.float64)
    covariance = torch.eye(2, dtype=torch.float64)
    track = []
    for measured, share in zip(z, shares, strict=True):
        information = torch.zeros(2, 2, dtype=torch.float64)
        vector = torch.zeros(2, dtype=torch.float64)
        for value, beta, noise in zip(measured, (share, 1.0 - share), NOISE, strict=True):
            prior = motion @ (covariance / beta) @ motion.mT + process / beta
            local = torch.linalg.inv(prior)
            information = information + local + torch.outer(row, row) / noise
            vector = vector + local @ (motion @ mean) + row * value / noise
        covariance = torch.linalg.inv(information)
        mean = covariance @ vector
        track.append(mean)
    return torch.stack(track)
