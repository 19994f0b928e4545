"""Inverse kinematics of many frames at once: damped Gauss-Newton on positions and rotations.

The damping of each frame is its own (Levenberg and Marquardt): a step that makes a frame worse is
taken back and tried shorter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from warmstart.mocap.kinematics import Chain, Frames, exp, log

CHUNK = 128
"""Frames solved together: the Jacobians of more do not stay in the cache."""
FIRST, LEAST, MOST = 1e-3, 1e-7, 1e3
"""Damping to begin with and its bounds, relative to the diagonal of the normal equations."""
FLOOR = 1e-6
"""Damping that is always there, for directions that nothing holds."""
LARGEST = 0.6
"""No link turns by more than this in a step (rad)."""
STEPS = 4


@dataclass(frozen=True, eq=False)
class Aim:
    """What a fit minimises, as sums of squares.

    ``sum w_j^2 |p_j - target_j|^2 + sum |h_i log(guess_i^T local_i)|^2``: joints near their
    targets, and every link near its first guess against its parent. At a first guess that meets the
    targets both are zero, whatever the weights.
    """

    targets: Mapping[str, np.ndarray]
    """Joint -> (T, 3) m."""
    weights: Mapping[str, float]
    """Joint -> weight (1 = one metre counts one)."""
    hold: Mapping[str, float | tuple[float, float, float]]
    """Link -> weight of its guess (per rad), also by axis; links that are left out do not move."""
    hold_root: float = 0.0
    """Weight of the root's guessed place (per m)."""


def fit(
    chain: Chain, root: np.ndarray, local: np.ndarray, aim: Aim, steps: int = STEPS
) -> tuple[np.ndarray, np.ndarray]:
    """Root positions (T, 3) and local rotations (T, B, 3, 3) nearest the aim, from a first guess.

    Rotations are updated on the right, ``R <- R exp(delta)``, so that there is no singular pose.
    """
    plan = _Plan(chain, aim)
    out_root, out_local = root.copy(), local.copy()
    for start in range(0, len(root), CHUNK):
        rows = slice(start, start + CHUNK)
        target = np.stack([aim.targets[name][rows] for name in plan.names], axis=1)
        problem = _Problem(plan, root[rows], local[rows], target)
        for _ in range(steps):
            problem.step()
        out_root[rows], out_local[rows] = problem.best_root, problem.best_local
    return out_root, out_local


class _Plan:
    """The sparsity of the problem, worked out once."""

    def __init__(self, chain: Chain, aim: Aim) -> None:
        self.chain = chain
        self.names = [name for name in aim.targets if aim.weights.get(name, 0.0) > 0]
        self.joints = np.array([chain.index[name] for name in self.names])
        self.weight = np.array([aim.weights[name] for name in self.names])
        self.links = np.array([chain.index[name] for name in aim.hold])
        self.hold = np.array([np.broadcast_to(h, 3) for h in aim.hold.values()], dtype=float)
        """(L, 3)"""
        self.hold_root = aim.hold_root
        column = {link: k for k, link in enumerate(self.links)}
        pairs = [
            (k, column[a], joint, a)
            for k, joint in enumerate(self.joints)
            for a in chain.ancestors[joint]
            if a in column
        ]
        self.pair_row, self.pair_column, self.pair_joint, self.pair_link = np.array(pairs).T
        self.width = 3 + 3 * len(self.links)

    def jacobian(self, frames: Frames) -> np.ndarray:
        """(T, 3 K, 3 + 3 L) derivative of the weighted joints by root and link rotations."""
        count = len(frames.origin)
        out = np.zeros((count, len(self.joints), 3, self.width))
        out[..., :3] = self.weight[:, None, None] * np.eye(3)
        arm = frames.origin[:, self.pair_joint] - frames.origin[:, self.pair_link]
        arm = arm * self.weight[self.pair_row][:, None]
        turn = frames.turn[:, self.pair_link]
        x, y, z = arm[..., 0, None], arm[..., 1, None], arm[..., 2, None]
        a, b, c = turn[..., 0, :], turn[..., 1, :], turn[..., 2, :]
        block = np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=-2)
        view = out[..., 3:].reshape(count, len(self.joints), 3, len(self.links), 3)
        view[:, self.pair_row, :, self.pair_column] = np.moveaxis(block, 1, 0)
        out[..., 3:] = view.reshape(count, len(self.joints), 3, -1)
        return out.reshape(count, -1, self.width)


class _Problem:
    """Some frames on their way."""

    def __init__(
        self, plan: _Plan, root: np.ndarray, local: np.ndarray, target: np.ndarray
    ) -> None:
        self.plan = plan
        self.guess_root, self.guess_local, self.target = root, local[:, plan.links], target
        self.damping = np.full(len(root), FIRST)
        self.best_root, self.best_local = root, local
        self.cost, self.error, self.away, self.frames = self._weigh(root, local)

    def _weigh(self, root: np.ndarray, local: np.ndarray) -> tuple:
        """Cost (T,), weighted errors of joints, turns away from the guess, and kinematics."""
        plan = self.plan
        frames = plan.chain.frames(root, local)
        error = (self.target - frames.origin[:, plan.joints]) * plan.weight[:, None]
        away = log(np.swapaxes(self.guess_local, -1, -2) @ local[:, plan.links])
        cost = (error**2).sum((1, 2)) + ((plan.hold * away) ** 2).sum((1, 2))
        cost += plan.hold_root**2 * ((root - self.guess_root) ** 2).sum(1)
        return cost, error, away, frames

    def step(self) -> None:
        """One step of every frame; those that it makes worse stay where they are."""
        plan, count = self.plan, len(self.cost)
        jacobian = plan.jacobian(self.frames)
        normal = np.swapaxes(jacobian, 1, 2) @ jacobian
        slope = (np.swapaxes(jacobian, 1, 2) @ self.error.reshape(count, -1, 1))[..., 0]
        stiff = (plan.hold**2).ravel()
        slope[:, 3:] -= stiff * self.away.reshape(count, -1)
        slope[:, :3] -= plan.hold_root**2 * (self.best_root - self.guess_root)
        index = np.arange(plan.width)
        normal[:, index, index] += np.concatenate([np.full(3, plan.hold_root**2), stiff])
        normal[:, index, index] *= 1.0 + self.damping[:, None]
        normal[:, index, index] += FLOOR
        delta = np.linalg.solve(normal, slope[..., None])[..., 0]
        turn = delta[:, 3:].reshape(count, -1, 3)
        size = np.linalg.norm(turn, axis=-1).max(1)
        share = np.minimum(1.0, LARGEST / np.maximum(size, 1e-12))[:, None]
        root = self.best_root + share * delta[:, :3]
        local = self.best_local.copy()
        local[:, plan.links] = local[:, plan.links] @ exp(share[..., None] * turn)
        cost, error, away, frames = self._weigh(root, local)
        good = cost <= self.cost
        self.damping = np.clip(np.where(good, self.damping / 8, self.damping * 8), LEAST, MOST)
        if good.all():
            self.best_root, self.best_local = root, local
            self.cost, self.error, self.away, self.frames = cost, error, away, frames
            return

        def pick(new: np.ndarray, old: np.ndarray) -> np.ndarray:
            return np.where(good.reshape(-1, *(1,) * (new.ndim - 1)), new, old)

        self.best_root, self.best_local = pick(root, self.best_root), pick(local, self.best_local)
        self.cost, self.error = pick(cost, self.cost), pick(error, self.error)
        self.away = pick(away, self.away)
        self.frames = Frames(
            pick(frames.origin, self.frames.origin), pick(frames.turn, self.frames.turn)
        )
