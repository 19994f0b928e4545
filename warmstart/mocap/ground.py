"""Feet on the floor: contacts, grounding frame by frame, and feet that stay where they stand.

A sole has two parts that bear weight, heel and ball. A part is in contact when it is slow and low.
Where a foot is down the athlete is moved so that its sole is on the floor; between contacts, in a
flight, the move passes smoothly from one to the next, so that a flight keeps its arc. Then the legs
take up what is left, so that soles in contact are level with the floor and do not slide.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import (
    binary_closing,
    gaussian_filter1d,
    maximum_filter1d,
    minimum_filter1d,
)

from warmstart.mocap.capture import SIDES, unit
from warmstart.mocap.kinematics import Chain, Frames, exp, log, swing
from warmstart.mocap.limbs import limb_of, move_end, stretch

SLOW, FAST = 0.3, 0.7
"""A part of a sole in contact stands when it moves at less than the first (m/s), and leaves its
place when it moves at more than the second; between them what went before goes on."""
LOW = 0.06
"""It is at most this far (m) above the lowest place of both feet within ``AROUND``..."""
AROUND = 0.6
"""... seconds before and after."""
LOWEST = 0.06
"""And at most this far (m) above the lowest point of the body."""
SMOOTH = 0.05
"""Standard deviation (s) of the smoothing of the move."""
BLEND = 0.25
"""A correction of a foot dies away within this time (s) from its contact."""
SLIDE = 0.15
"""A contact that slides further than this (m) is left to slide by the rest."""
EASE = 0.05
"""A foot takes this long (s) to come to rest or to leave."""
LOWERED = 0.03
"""The hips come down by at most this (m) in one pass for a foot out of reach."""
ROLL = 0.8
"""Largest roll that lays a sole flat (rad)."""
WRIST = 1.4
"""Largest turn of a wrist that keeps fingers out of the floor (rad)."""
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Contacts:
    """What the source's motion says about its feet."""

    down: np.ndarray
    """(T, 2, 2) whether left, right foot's heel, ball is in contact."""
    stays: np.ndarray
    """(T - 1, 2, 2) whether it stays in its place from a frame to the next."""

    @property
    def foot(self) -> np.ndarray:
        """(T, 2) whether any part of a foot is."""
        return np.any(self.down, axis=-1)


@dataclass(frozen=True, eq=False)
class Grounded:
    """A motion on the floor, and what it took."""

    root: np.ndarray
    local: np.ndarray
    contacts: Contacts
    moved: np.ndarray
    """(T,) how far the whole athlete was moved upward (m)."""


class Soles:
    """Places of heel and ball of both feet, from the shapes of ankle and toe links."""

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        self.sets: list[list[np.ndarray]] = []
        middle: list[list[tuple[int, np.ndarray]]] = []
        for side in SIDES:
            ankle, toe = chain.index[side + "Ankle"], chain.index[side + "Toe"]
            of_ankle = np.flatnonzero(chain.surface_link == ankle)
            x = chain.surface_point[of_ankle, 0]
            back = of_ankle[x < x.mean()]
            front = np.concatenate(
                [of_ankle[x >= x.mean()], np.flatnonzero(chain.surface_link == toe)]
            )
            self.sets.append([back, front])
            low = back[np.argsort(chain.surface_point[back, 2])[:2]]
            heel = (ankle, chain.surface_point[low].mean(0))
            point = chain.surface_point[chain.surface_link == toe]
            ball = (toe, np.array([0.0, point[:, 1].mean(), point[:, 2].min()]))
            middle.append([heel, ball])
        self.middle = middle
        self.feet = np.concatenate([np.concatenate(s) for s in self.sets])
        self.arms = [
            np.flatnonzero(np.isin(chain.surface_link, [chain.index[n] for n in links]))
            for links in (chain.body.subtree(side + "Elbow") for side in SIDES)
        ]
        """Points of each forearm and hand."""
        self.hands = []
        """(length, half thickness) of each hand beyond the wrist (m)."""
        for side in SIDES:
            links = [chain.index[name] for name in chain.body.subtree(side + "Wrist")]
            on = np.isin(chain.surface_link, links)
            place = chain.rest[chain.surface_link[on]] - chain.rest[links[0]]
            place = place + chain.surface_point[on]
            length = float((np.abs(place[:, 1]) + chain.surface_radius[on]).max())
            low = float((chain.surface_radius[on] - place[:, 2]).max())
            self.hands.append((length, low))

    def heights(self, surface: np.ndarray) -> np.ndarray:
        """(T, 2, 2) height of the lowest point of each part, from heights (T, S) of all points."""
        return np.stack(
            [np.stack([surface[:, s].min(1) for s in foot], -1) for foot in self.sets], axis=1
        )

    def places(self, frames: Frames) -> np.ndarray:
        """(T, 2, 2, 3) middle of each part's contact line (m)."""
        rows = [
            np.stack([frames.origin[:, i] + frames.turn[:, i] @ p for i, p in foot], axis=1)
            for foot in self.middle
        ]
        return np.stack(rows, axis=1)


def find_contacts(chain: Chain, frames: Frames, fps: float) -> Contacts:
    """Which parts of the soles are in contact, from a motion that was not grounded yet."""
    soles = Soles(chain)
    surface = chain.heights(frames)
    height, place = soles.heights(surface), soles.places(frames)
    step = np.linalg.norm(np.diff(place, axis=0), axis=-1) * fps
    # The slower of the steps before and after: a sprinter's foot stands for four frames.
    slow = step < SLOW
    down = np.concatenate([slow[:1], slow]) | np.concatenate([slow, slow[-1:]])
    reach = 2 * round(AROUND * fps) + 1
    base = minimum_filter1d(height.min((1, 2)), reach, mode="nearest")
    low = height < base[:, None, None] + LOW
    low &= height < surface.min(1)[:, None, None] + LOWEST
    down &= low
    gap = np.ones((max(2, round(0.05 * fps)), 1, 1), dtype=bool)
    closed = binary_closing(np.pad(down, ((9, 9), (0, 0), (0, 0)), mode="edge"), gap)[9:-9]
    slowish = np.concatenate([step[:1], step]) < FAST
    down |= closed & low & slowish
    return Contacts(down, down[1:] & down[:-1] & (step < FAST))


def ground(
    chain: Chain, root: np.ndarray, local: np.ndarray, fps: float, passes: int = 2
) -> Grounded:
    """Puts a motion (T frames, z up, any height) on the floor z = 0."""
    soles = Soles(chain)
    local = _level_toes(chain, chain.frames(root, local), local, fps)
    frames = chain.frames(root, local)
    contacts = find_contacts(chain, frames, fps)
    local = _level_soles(chain, frames, local, contacts, fps)
    surface = chain.heights(chain.frames(root, local))
    moved = _move(soles, surface, contacts, fps)
    root = root + moved[:, None] * UP
    local = _level_hands(chain, soles, chain.frames(root, local), local)
    for _ in range(passes):
        root, local = _plant(chain, soles, root, local, contacts, fps)
    low = chain.heights(chain.frames(root, local)).min(1)
    rest = _cover(np.maximum(0.0, -0.005 - low), fps)
    root = root + rest[:, None] * UP
    return Grounded(root, local, contacts, moved + rest)


def _move(soles: Soles, surface: np.ndarray, contacts: Contacts, fps: float) -> np.ndarray:
    """(T,) upward move of the whole athlete (m)."""
    height = np.where(contacts.down, soles.heights(surface), np.inf).min((1, 2))
    known = np.flatnonzero(np.isfinite(height))
    if len(known):
        move = np.interp(np.arange(len(height)), known, -height[known])
        move = gaussian_filter1d(move, SMOOTH * fps, mode="nearest")
    else:
        move = np.full(len(height), -np.percentile(surface.min(1), 2))
    others = np.ones(surface.shape[1], dtype=bool)
    others[np.concatenate([soles.feet, *soles.arms])] = False  # they have limbs to give way
    sunk = np.maximum(0.0, -(surface[:, others].min(1) + move))
    return move + _cover(sunk, fps)


def _cover(need: np.ndarray, fps: float) -> np.ndarray:
    """(T,) a smooth curve nowhere below ``need`` (T,) >= 0, and zero far from where it is > 0."""
    width = 0.1 * fps
    wide = maximum_filter1d(need, 2 * max(1, round(2 * width)) + 1, mode="nearest")
    return np.maximum(need, gaussian_filter1d(wide, width, mode="nearest", truncate=2.0))


def _level_toes(chain: Chain, frames: Frames, local: np.ndarray, fps: float) -> np.ndarray:
    """Bends toes up where a foot rolls over them, instead of into the floor."""
    toes = [chain.index[side + "Toe"] for side in SIDES]
    joint = frames.origin[:, toes, 2]
    floor = minimum_filter1d(joint.min(1), 2 * round(AROUND * fps) + 1, mode="nearest")
    local = local.copy()
    for toe, height in zip(toes, joint.T):
        near = np.clip(2.0 - (height - floor) / 0.06, 0.0, 1.0)
        down = np.arcsin(np.clip(-frames.turn[:, toe, 2, 0], -1, 1))
        upright = frames.turn[:, toe, 2, 2] > 0.2  # not for a foot on its back
        bend = np.clip(down - 0.05, 0.0, 1.0) * near * upright
        local[:, toe] = local[:, toe] @ exp(-bend[:, None] * np.array([0.0, 1.0, 0.0]))
    return local


def _level_soles(
    chain: Chain, frames: Frames, local: np.ndarray, contacts: Contacts, fps: float
) -> np.ndarray:
    """Rolls feet in contact so that they stand on the sole, not on an edge of it.

    Few recordings know how an ankle rolls: in a wide stance their feet lean with the shins.
    """
    local = local.copy()
    for foot, side in enumerate(SIDES):
        ankle = chain.index[side + "Ankle"]
        across, upward = frames.turn[:, ankle, 2, 1], frames.turn[:, ankle, 2, 2]
        roll = -np.clip(np.arctan2(across, upward), -ROLL, ROLL)
        share = gaussian_filter1d(contacts.foot[:, foot].astype(float), EASE * fps, mode="nearest")
        share *= np.clip((upward - 0.3) / 0.3, 0.0, 1.0)  # not for a foot on its side or back
        local[:, ankle] = local[:, ankle] @ exp((share * roll)[:, None] * np.array([1.0, 0.0, 0.0]))
    return local


def _level_hands(chain: Chain, soles: Soles, frames: Frames, local: np.ndarray) -> np.ndarray:
    """Bends wrists where fingers would point into the floor, as far as is needed.

    Fingers turn the way they point already, or to the back of the hand when they point down.
    """
    local = local.copy()
    for side, sign, (length, depth) in zip(SIDES, (1.0, -1.0), soles.hands):
        wrist, elbow = chain.index[side + "Wrist"], chain.index[side + "Elbow"]
        turn = frames.turn[:, wrist]
        fingers, back = sign * turn[:, :, 1], turn[:, :, 2]
        room = np.clip((frames.origin[:, wrist, 2] - depth) / length, 0.0, 1.0)
        over = fingers * (1 - UP) + 0.6 * back * (1 - UP)
        down = np.maximum(fingers[:, 2], -room)[:, None]
        goal = unit(over) * np.sqrt(np.maximum(0.0, 1 - down**2)) + down * UP
        bend = np.where((fingers[:, 2] < -room)[:, None], log(swing(fingers, unit(goal))), 0.0)
        size = np.linalg.norm(bend, axis=1, keepdims=True)
        bend *= np.minimum(1.0, WRIST / np.maximum(size, 1e-9))
        local[:, wrist] = np.swapaxes(frames.turn[:, elbow], 1, 2) @ exp(bend) @ turn
    return local


def _plant(
    chain: Chain,
    soles: Soles,
    root: np.ndarray,
    local: np.ndarray,
    contacts: Contacts,
    fps: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Legs bent so that soles in contact are on the floor and stay in place; arms lifted out of
    the floor."""
    frames = chain.frames(root, local)
    surface = chain.heights(frames)
    height, place = soles.heights(surface), soles.places(frames)
    local = local.copy()
    lower = np.zeros(len(root))
    moves = []
    for foot, side in enumerate(SIDES):
        leg = limb_of(side, "leg")
        shift = _correction(
            height[:, foot], place[:, foot], contacts.down[:, foot], contacts.stays[:, foot], fps
        )
        moves.append((leg, shift))
        lower = np.maximum(lower, stretch(chain, frames, leg, shift) * contacts.foot[:, foot])
        sunk = _cover(np.maximum(0.0, -surface[:, soles.arms[foot]].min(1)), fps)
        if sunk.any():
            moves.append((limb_of(side, "arm"), sunk[:, None] * UP))
    # The hips come down a little where a leg is too short for what is asked of it.
    down = np.minimum(_cover(lower, fps), LOWERED)[:, None] * UP
    for limb, shift in moves:
        move_end(chain, frames, local, limb, shift + (down if limb[0].endswith("Hip") else 0.0))
    return root - down, local


def _correction(
    height: np.ndarray, place: np.ndarray, down: np.ndarray, stays: np.ndarray, fps: float
) -> np.ndarray:
    """(T, 3) by how much a foot must be moved: heights and places of heel and ball (T, 2, ...)."""
    frames = len(height)
    shift = np.zeros((frames, 3))
    known = down.any(1)
    shift[known, 2] = -height.min(1)[known]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], known.astype(int), [0]])))
    spans = list(zip(edges[::2], edges[1::2]))
    for first, last in spans:
        both = stays[first : last - 1]
        step = np.diff(place[first:last, :, :2], axis=0)
        step = (step * both[..., None]).sum(1) / np.maximum(both.sum(1), 1)[:, None]
        # Feet come to rest and leave over a moment, as they do.
        edge = np.minimum(np.arange(1, last - first), np.arange(last - first - 1, 0, -1))
        step *= np.minimum(1.0, edge / max(1.0, EASE * fps))[:, None]
        slide = np.cumsum(step, axis=0)
        slide = np.concatenate([np.zeros((1, 2)), slide])
        slide -= slide.mean(0)
        far = np.linalg.norm(slide, axis=1).max()
        shift[first:last, :2] = -slide * min(1.0, SLIDE / max(far, 1e-9))
    shift = _bridge(shift, spans, round(BLEND * fps))
    shift = gaussian_filter1d(shift, EASE / 2 * fps, axis=0, mode="nearest")
    sunk = np.maximum(0.0, -(height.min(1) + shift[:, 2]))
    inside = np.zeros(frames)  # 0 at the edges of a contact, 1 a moment within
    for first, last in spans:
        edge = np.minimum(np.arange(1, last - first + 1), np.arange(last - first, 0, -1))
        inside[first:last] = np.minimum(1.0, edge / max(1.0, EASE * fps))
    shift[:, 2] += (1.0 - inside) * _cover(sunk, fps)
    return shift


def _bridge(shift: np.ndarray, spans: list[tuple[int, int]], reach: int) -> np.ndarray:
    """Fills the frames between contacts: from one correction to the next, or down to none."""
    frames = len(shift)
    out = shift.copy()
    reach = max(reach, 1)
    ends = [(0, spans[0][0])] if spans else []
    ends += [(a[1], b[0]) for a, b in pairwise(spans)]
    ends += [(spans[-1][1], frames)] if spans else []
    for first, last in ends:
        size = last - first
        if size <= 0:
            continue
        s = np.arange(1, size + 1)
        before = shift[first - 1] if first > 0 else None
        after = shift[last] if last < frames else None
        if before is not None and after is not None and size <= 2 * reach:
            x = s / (size + 1)
            x = (x * x * (3 - 2 * x))[:, None]
            out[first:last] = (1 - x) * before + x * after
            continue
        part = np.zeros((size, 3))
        if before is not None:
            x = np.clip(1 - s / reach, 0, 1)[:, None]
            part += x * x * (3 - 2 * x) * before
        if after is not None:
            x = np.clip(1 - (size + 1 - s) / reach, 0, 1)[:, None]
            part += x * x * (3 - 2 * x) * after
        out[first:last] = part
    return out
