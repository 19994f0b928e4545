"""Do two sets of windows come from one distribution? A distance of normals, and a fresh classifier.

Both compare features (W, D) of windows. Windows of one clip or episode are alike, so the classifier
is tested on clips and episodes that it did not see; the caller says which window is of which.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import nn

FOLDS = 5
HIDDEN = 16
STEPS = 150
LEARNING_RATE = 0.03
WEIGHT_DECAY = 0.03


def frechet(a: np.ndarray, b: np.ndarray) -> float:
    """Squared Frechet distance of the normals with the moments of two samples (W, D).

    |m_a - m_b|^2 + tr(C_a + C_b - 2 (C_a^1/2 C_b C_a^1/2)^1/2) (Dowson and Landau 1982). Raises
    ValueError for fewer than two windows in a sample.
    """
    if len(a) < 2 or len(b) < 2:
        raise ValueError("a Frechet distance needs at least two windows on each side")
    return frechet_of_moments(a.mean(0), np.cov(a.T), b.mean(0), np.cov(b.T))


def frechet_of_moments(
    mean_a: np.ndarray, cov_a: np.ndarray, mean_b: np.ndarray, cov_b: np.ndarray
) -> float:
    """The same of means (D,) and covariances (D, D)."""
    cov_a, cov_b = np.atleast_2d(cov_a), np.atleast_2d(cov_b)
    root = _sqrt(cov_a)
    cross = np.sqrt(np.maximum(np.linalg.eigvalsh(root @ cov_b @ root), 0.0)).sum()
    apart = float(((mean_a - mean_b) ** 2).sum())
    return max(0.0, apart + float(np.trace(cov_a) + np.trace(cov_b) - 2.0 * cross))


def classifier_accuracy(
    a: np.ndarray, a_groups: Sequence[str], b: np.ndarray, b_groups: Sequence[str], seed: int = 0
) -> float:
    """Balanced accuracy with which a fresh network tells windows a (W, D) from b; 0.5 is chance.

    Cross-validated: groups (a clip, an episode) are dealt to as many folds as both sides have
    groups for, five at most, and each fold is told apart by a network trained on the others. The
    network has one hidden layer of 16 and sees features in deviations of its training windows; both
    sides weigh alike however many windows they have. NaN where a side has fewer than two groups.
    """
    count = min(FOLDS, len(set(a_groups)), len(set(b_groups)))
    if count < 2:
        return float("nan")
    fold_a, fold_b = _deal(a_groups, count), _deal(b_groups, count)
    right: list[list[np.ndarray]] = [[], []]
    for k in range(count):
        score = _fit(a[fold_a != k], b[fold_b != k], seed + k)
        right[0].append(score(a[fold_a == k]) < 0.0)
        right[1].append(score(b[fold_b == k]) > 0.0)
    return float(np.mean([np.concatenate(side).mean() for side in right]))


def _deal(groups: Sequence[str], folds: int) -> np.ndarray:
    """(W,) fold of each window; groups go, largest first, to the fold with the fewest windows."""
    names, of = np.unique(np.asarray(groups), return_inverse=True)
    sizes = np.bincount(of, minlength=len(names))
    load, fold = np.zeros(folds), np.zeros(len(names), dtype=int)
    for group in np.argsort(-sizes, kind="stable"):
        fold[group] = int(load.argmin())
        load[fold[group]] += sizes[group]
    return fold[of]


def _fit(a: np.ndarray, b: np.ndarray, seed: int):
    """A trained network as a function (W, D) -> (W,): above zero means b."""
    both = np.concatenate((a, b))
    middle, spread = both.mean(0), both.std(0) + 1e-6

    def scaled(x: np.ndarray) -> torch.Tensor:
        return torch.tensor((x - middle) / spread, dtype=torch.float32)

    x = scaled(both)
    y = torch.cat((torch.zeros(len(a)), torch.ones(len(b))))
    weight = torch.where(y > 0.5, 0.5 / len(b), 0.5 / len(a))
    generator = torch.Generator().manual_seed(seed)
    net = nn.Sequential(nn.Linear(x.shape[1], HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, 1))
    with torch.no_grad():
        for p in net.parameters():
            scale = p.shape[-1] ** -0.5 if p.ndim > 1 else 0.0
            p.copy_(scale * torch.randn(p.shape, generator=generator))
    optimiser = torch.optim.AdamW(net.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    loss = nn.BCEWithLogitsLoss(weight=weight, reduction="sum")
    for _ in range(STEPS):
        optimiser.zero_grad()
        loss(net(x).squeeze(-1), y).backward()
        optimiser.step()

    @torch.no_grad()
    def score(rows: np.ndarray) -> np.ndarray:
        return net(scaled(rows)).squeeze(-1).numpy()

    return score


def _sqrt(cov: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(cov)
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
