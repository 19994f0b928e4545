"""Inverse kinematics of many frames at once: damped Gauss-Newton on positions and rotations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from warmstart.mocap.kinematics import Chain, Frames, exp, log

CHUNK = 128
"""Frames solved together: the Jacobians of more do not stay in the cache."""
DAMPING = 1e-6
STEPS = 4


@dataclass(frozen=True, eq=False)
class Aim:
    """What a fit minimises, as sums of squares.

    ``sum w_j^2 |p_j - target_j|^2 + sum h_i^2 |log(guess_i^T local_i)|^2``: joints near their
    targets, and every link near its first guess against its parent. At a first guess that meets the
    targets both are zero, whatever the weights.
    """

    targets: Mapping[str, np.ndarray]
    """Joint -> (T, 3) m."""
    weights: Mapping[str, float]
    """Joint -> weight (1 = one metre counts one)."""
    hold: Mapping[str, float]
    """Link -> weight of its guess (per rad); links that are left out do not move."""
    hold_root: float = 0.0
    """Weight of the root's guessed place (per m)."""


def fit(
    chain: Chain, root: np.ndarray, local: np.ndarray, aim: Aim, steps: int = STEPS
) -> tuple[np.ndarray, np.ndarray]:
    """Root positions (T, 3) and local rotations (T, B, 3, 3) nearest the aim, from a first guess.

    Gauss-Newton with a fixed small damping; rotations are updated on the right,
    ``R <- R exp(delta)``, so that there is no singular pose.
    """
    plan = _Plan(chain, aim)
    out_root, out_local = root.copy(), local.copy()
    for start in range(0, len(root), CHUNK):
        rows = slice(start, start + CHUNK)
        r, q = root[rows], local[rows]
        guess_r, guess_q = r, q[:, plan.links]
        target = np.stack([aim.targets[name][rows] for name in plan.names], axis=1)
        for _ in range(steps):
            r, q = plan.step(r, q, guess_r, guess_q, target)
        out_root[rows], out_local[rows] = r, q
    return out_root, out_local


class _Plan:
    """The sparsity of the problem, worked out once."""

    def __init__(self, chain: Chain, aim: Aim) -> None:
        self.chain = chain
        self.names = [name for name in aim.targets if aim.weights.get(name, 0.0) > 0]
        self.joints = np.array([chain.index[name] for name in self.names])
        self.weight = np.array([aim.weights[name] for name in self.names])
        self.links = np.array([chain.index[name] for name in aim.hold])
        self.hold = np.array(list(aim.hold.values()))
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

    def step(
        self,
        root: np.ndarray,
        local: np.ndarray,
        guess_root: np.ndarray,
        guess_local: np.ndarray,
        target: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        frames = self.chain.frames(root, local)
        jacobian = self._jacobian(frames)
        error = (target - frames.origin[:, self.joints]) * self.weight[:, None]
        normal = np.swapaxes(jacobian, 1, 2) @ jacobian
        slope = (np.swapaxes(jacobian, 1, 2) @ error.reshape(len(root), -1, 1))[..., 0]
        away = log(np.swapaxes(guess_local, -1, -2) @ local[:, self.links])
        stiff = np.repeat(self.hold**2, 3)
        slope[:, 3:] -= stiff * away.reshape(len(root), -1)
        slope[:, :3] -= self.hold_root**2 * (root - guess_root)
        diagonal = np.concatenate([np.full(3, self.hold_root**2), stiff]) + DAMPING
        index = np.arange(self.width)
        normal[:, index, index] += diagonal
        delta = np.linalg.solve(normal, slope[..., None])[..., 0]
        turn = delta[:, 3:].reshape(len(root), -1, 3)
        size = np.linalg.norm(turn, axis=-1, keepdims=True)
        turn = turn / np.maximum(1.0, size / 0.8)  # no link turns by more than 0.8 rad a step
        local = local.copy()
        local[:, self.links] = local[:, self.links] @ exp(turn)
        return root + delta[:, :3], local

    def _jacobian(self, frames: Frames) -> np.ndarray:
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
