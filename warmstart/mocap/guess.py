"""The source on our bones: where our joints should be, and a first guess of every link's turn.

Lengths. The path of the hips is scaled by the ratio of the legs. Bones keep the source's direction
and take our length; hips, neck and shoulders keep the source's place in the trunk, about our rest
place, scaled by our width (rigs put the same joint elsewhere in the trunk, up to 7 cm).

Turns. Pelvis from hips and neck, chest from shoulders, thighs and upper arms from their direction
and the plane of the limb, all of them following the source's own rotations where it has them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warmstart.mocap.capture import KEY_JOINTS, SIDES, Capture, unit
from warmstart.mocap.kinematics import (
    Chain,
    exp,
    log,
    nearest_rotation,
    quaternion,
    swing,
)
from warmstart.mocap.limbs import bend_for, hinge_of, limb_of

BENT = 0.25
"""A limb shows its plane from this sine of its bend on; below, its twist is carried over."""
OWN = 1e-4
"""A skeleton is ours when its joints lie this near (m) where our bones would put them."""
WRIST = 2.1
"""A hand that is turned against its forearm by more than this (rad) is a glitch."""
LEVEL = 0.12
"""A foot is taken to lie flat when it is this slow (m/s, scaled) and near its lowest."""


@dataclass(frozen=True, eq=False)
class Guess:
    """A first pose and its targets, in metres of our body."""

    targets: dict[str, np.ndarray]
    """Key joint -> (T, 3)."""
    scaled: dict[str, np.ndarray]
    """Key joint -> (T, 3): the source's own joints, scaled by the ratio of the legs alone."""
    root: np.ndarray
    turn: np.ndarray
    """(T, B, 3, 3) world <- link."""


def first_guess(chain: Chain, capture: Capture) -> Guess:
    """Targets and a first pose of our body. A source with our very bones is copied."""
    turn = _own_turns(chain, capture)
    if turn is None:
        return _Guesser(chain, capture).guess()
    points = {name: capture.points[name] for name in KEY_JOINTS}
    return Guess(points, points, capture.points["Pelvis"], turn)


def _own_turns(chain: Chain, capture: Capture) -> np.ndarray | None:
    """(T, B, 3, 3) rotations of a source whose skeleton is our body; None for another skeleton."""
    if capture.rest != "t_pose" or not set(chain.names) <= set(capture.turns):
        return None
    if not {"Pelvis", *KEY_JOINTS} <= set(capture.points):
        return None
    turn = np.stack([capture.turns[name] for name in chain.names], axis=1)
    origin = chain.frames(capture.points["Pelvis"], chain.local(turn)).origin
    off = [np.abs(origin[:, chain.index[n]] - capture.points[n]).max() for n in KEY_JOINTS]
    return turn if max(off) < OWN else None


class _Guesser:
    def __init__(self, chain: Chain, capture: Capture) -> None:
        self.chain, self.capture = chain, capture
        self.p = capture.points
        self.frames = capture.num_frames
        leg = sum(chain.length(s + "Hip", s + "Knee") + chain.length(s + "Knee", s + "Ankle")
                  for s in SIDES) / 2  # fmt: skip
        self.scale = leg / capture.leg
        self.rest = {name: chain.rest[i] for name, i in chain.index.items()}
        self.targets: dict[str, np.ndarray] = {}
        self.turn: dict[str, np.ndarray] = {}

    def guess(self) -> Guess:
        self._trunk()
        self._limbs()
        self._head()
        for name in self.chain.names:  # hands, toes, fingers: as their parent
            if name not in self.turn:
                parent = self.chain.names[self.chain.parent[self.chain.index[name]]]
                self.turn[name] = self.turn[parent]
        turn = np.stack([self.turn[name] for name in self.chain.names], axis=1)
        scaled = {k: self.scale * v for k, v in self.p.items() if k in KEY_JOINTS}
        return Guess(self.targets, scaled, self.root, turn)

    def _bone(self, a: str, b: str) -> np.ndarray:
        """Direction of a source's bone, (T, 3)."""
        return unit(self.p[b] - self.p[a])

    def _rest_bone(self, a: str, b: str) -> np.ndarray:
        return unit(self.rest[b] - self.rest[a])

    def _trunk(self) -> None:
        p, rest = self.p, self.rest
        middle = 0.5 * (p["L_Hip"] + p["R_Hip"])
        rest_middle = 0.5 * (rest["L_Hip"] + rest["R_Hip"])
        spine, across = p["Neck"] - middle, p["L_Hip"] - p["R_Hip"]
        rest_spine, rest_across = rest["Neck"] - rest_middle, rest["L_Hip"] - rest["R_Hip"]
        plain = _frame(across, spine) @ _frame(rest_across, rest_spine).T
        pelvis = self._follow("Pelvis", plain, np.ones(self.frames))
        broad, rest_broad = (x["L_Shoulder"] - x["R_Shoulder"] for x in (p, rest))
        plain = _frame(broad, spine) @ _frame(rest_broad, rest_spine).T
        chest = self._follow("Chest", plain, np.ones(self.frames))
        between = log(np.swapaxes(pelvis, 1, 2) @ chest)
        self.turn |= {
            "Pelvis": pelvis,
            "Torso": pelvis @ exp(between / 3),
            "Spine": pelvis @ exp(between * 2 / 3),
            "Chest": chest,
        }
        hips = self.scale * middle
        self.root = hips - pelvis @ rest_middle
        half = 0.5 * np.linalg.norm(rest_across)
        for side, sign in zip(SIDES, (1.0, -1.0)):
            self.targets[side + "Hip"] = hips + sign * half * unit(across)
        long, wide = (np.linalg.norm(x, axis=1) for x in (spine, broad))
        reach = np.linalg.norm(rest_spine) / max(float(np.percentile(long, 90)), 0.05)
        neck = self.targets["Neck"] = hips + reach * spine
        upper = _frame(broad, spine)
        rest_upper = _frame(rest_broad, rest_spine)
        widen = np.linalg.norm(rest_broad) / max(float(np.median(wide)), 0.05)
        for side in SIDES:
            name = side + "Shoulder"
            place = np.swapaxes(upper, 1, 2) @ (p[name] - p["Neck"])[..., None]
            ours = rest_upper.T @ (rest[name] - rest["Neck"])
            place = ours + widen * (place[..., 0] - np.median(place[..., 0], axis=0))
            self.targets[name] = neck + (upper @ place[..., None])[..., 0]
            self.turn[side + "Thorax"] = chest
        self.turn["Neck"] = self._bend("Neck", chest)

    def _limbs(self) -> None:
        for side in SIDES:
            self._limb(limb_of(side, "leg"), "Pelvis")
            self._limb(limb_of(side, "arm"), "Chest")
            self._foot(side)
            self._hand(side)

    def _limb(self, limb: tuple[str, str, str], parent: str) -> None:
        """Both links of a leg or an arm, and the targets of its joints.

        The second link turns about its hinge alone here. The end of the limb is met, the middle up
        to a centimetre or two: our bones do not lie in the plane that the hinge turns in.
        """
        a, b, c = limb
        upper, lower = self._bone(a, b), self._bone(b, c)
        first, second = self.chain.length(a, b), self.chain.length(b, c)
        self.targets[b] = self.targets[a] + first * upper
        self.targets[c] = self.targets[b] + second * lower
        hinge = hinge_of(b)
        bones = self.rest[b] - self.rest[a], self.rest[c] - self.rest[b]
        reach = first * upper + second * lower
        bend, _ = bend_for(*bones, hinge, np.linalg.norm(reach, axis=1))
        bent = exp(bend[:, None] * hinge)
        span = unit(bones[0] + bent @ bones[1])
        reach = unit(reach)
        # First bone x second bone is the axis of the limb's plane.
        normal = np.cross(upper, lower)
        sure = np.clip(np.linalg.norm(normal, axis=1) / BENT - 0.5, 0.0, 1.0)
        across = np.where(sure[:, None] > 0, normal, self.turn[parent] @ hinge)
        plain = _frame(across, reach) @ np.swapaxes(
            _frame(np.broadcast_to(hinge, span.shape), span), 1, 2
        )
        if a in self.capture.turns:
            turn = self._follow(a, plain, sure)
        else:
            turn = self._twist(self.turn[parent], span, reach, plain, sure)
        self.turn[a] = self._aligned(turn, span, reach)
        self.turn[b] = self.turn[a] @ bent

    def _hand(self, side: str) -> None:
        """The hand; the forearm takes half of its twist, as bones do.

        With all of it the wrist would turn 90 degrees about its middle hinge, where hinges lock.
        """
        elbow, wrist = side + "Elbow", side + "Wrist"
        forearm = self.turn[elbow]
        local = log(np.swapaxes(forearm, 1, 2) @ self._bend(wrist, forearm))
        good = np.linalg.norm(local, axis=1) < WRIST
        if good.any() and not good.all():  # glitches of a recording
            at = np.arange(self.frames)
            local = np.stack([np.interp(at, at[good], x[good]) for x in local.T], axis=1)
        self.turn[wrist] = hand = forearm @ exp(local)
        axis = self._rest_bone(elbow, wrist)
        quat = quaternion(np.swapaxes(forearm, 1, 2) @ hand)
        twist = np.unwrap(2 * np.arctan2(quat[:, 1:] @ axis, quat[:, 0]))
        twist -= 2 * np.pi * np.round(np.median(twist) / (2 * np.pi))
        self.turn[elbow] = forearm @ exp(0.5 * twist[:, None] * axis)

    def _foot(self, side: str) -> None:
        """The foot's link and toe; its pitch is set so that a foot that rests is flat."""
        ankle, toe = side + "Ankle", side + "Toe"
        shin = self.turn[side + "Knee"]
        if toe not in self.p:
            self.turn[ankle] = self._bend(ankle, shin)
            return
        bone = self._bone(ankle, toe)
        side_axis = shin @ np.array([0.0, 1.0, 0.0])
        side_axis = unit(side_axis - (side_axis * bone).sum(1, keepdims=True) * bone)
        rest_bone = self._rest_bone(ankle, toe)
        lift = self._resting_pitch(ankle, toe) - np.arcsin(rest_bone[2])
        bone = (exp(side_axis * lift) @ bone[..., None])[..., 0]
        plain = _frame(side_axis, bone) @ _frame(np.array([0.0, 1.0, 0.0]), rest_bone).T
        turn = self._follow(ankle, plain, np.ones(self.frames))
        self.turn[ankle] = self._aligned(turn, rest_bone, bone)
        self.targets[toe] = self.targets[ankle] + self.chain.length(ankle, toe) * bone

    def _resting_pitch(self, ankle: str, toe: str) -> float:
        """Angle (rad, up is positive) of the source's foot over the ground while it rests."""
        p = self.scale * self.p[ankle]
        speed = np.linalg.norm(np.gradient(p, 1 / self.capture.fps, axis=0), axis=1)
        low = p[:, 2] < np.percentile(p[:, 2], 20) + 0.03
        rests = low & (speed <= max(LEVEL, np.percentile(speed, 10)))
        pitch = np.arcsin(np.clip(self._bone(ankle, toe)[:, 2], -1, 1))
        own = float(np.median(pitch[rests] if rests.sum() >= 3 else pitch[low]))
        return float(np.clip(own, -1.0, 0.3))

    def _head(self) -> None:
        if "Head" in self.p:
            bone, chest = self._bone("Neck", "Head"), self.turn["Chest"]
            usual = unit(np.median(np.swapaxes(chest, 1, 2) @ bone[..., None], axis=0)[:, 0])
            if self.capture.rest == "t_pose" and "Neck" in self.capture.turns:
                neck = self.turn["Neck"]
                usual = unit(np.median(np.swapaxes(neck, 1, 2) @ bone[..., None], axis=0)[:, 0])
            rest_bone = self._rest_bone("Neck", "Head")
            fixed = swing(usual, rest_bone)
            local = np.swapaxes(chest, 1, 2) @ bone[..., None]
            bone = (chest @ (fixed @ local))[..., 0]
            self.targets["Head"] = self.targets["Neck"] + self.chain.length("Neck", "Head") * bone
            self.turn["Neck"] = self._aligned(self.turn["Neck"], rest_bone, bone)
        self.turn["Head"] = self._bend("Head", self.turn["Neck"])

    def _bend(self, link: str, parent: np.ndarray) -> np.ndarray:
        """A link whose own joints do not show its turn: the source's, else its parent's."""
        return self._follow(link, parent, np.ones(self.frames))

    def _follow(self, link: str, plain: np.ndarray, sure: np.ndarray) -> np.ndarray:
        """The source's rotation of a link, brought to our axes; ``plain`` where it has none.

        Where the source's axes are unknown they are the fixed rotation that fits ``plain`` best
        over the frames, each counted as far as ``plain`` is ``sure`` (T,).
        """
        theirs = self.capture.turns.get(link)
        if theirs is None:
            return plain
        if self.capture.rest == "t_pose":
            return theirs
        weight = sure if sure.sum() > 3 else np.ones(len(sure))
        mean = (weight[:, None, None] * (np.swapaxes(theirs, 1, 2) @ plain)).sum(0)
        return theirs @ nearest_rotation(mean)

    def _aligned(self, turn: np.ndarray, rest_bone: np.ndarray, bone: np.ndarray) -> np.ndarray:
        """The smallest further turn that points the link's bone the right way."""
        now = (turn @ np.broadcast_to(rest_bone, bone.shape)[..., None])[..., 0]
        return swing(now, bone) @ turn

    def _twist(
        self,
        parent: np.ndarray,
        rest_bone: np.ndarray,
        bone: np.ndarray,
        plain: np.ndarray,
        sure: np.ndarray,
    ) -> np.ndarray:
        """Without rotations of the source: twist from the limb's plane, held while straight."""
        swung = self._aligned(parent, rest_bone, bone)
        twist = (log(np.swapaxes(swung, 1, 2) @ plain) * rest_bone).sum(-1)
        known = np.flatnonzero(sure > 0.5)
        if len(known) == 0:
            return swung
        angle = np.interp(np.arange(self.frames), known, np.unwrap(twist[known]))
        return swung @ exp(angle[:, None] * rest_bone)


def _frame(across: np.ndarray, along: np.ndarray) -> np.ndarray:
    """(..., 3, 3) with the axes: ``across`` made normal to ``along``, their product, ``along``."""
    third = unit(along)
    second = unit(across - (across * third).sum(-1, keepdims=True) * third)
    return np.stack([np.cross(second, third), second, third], axis=-1)
