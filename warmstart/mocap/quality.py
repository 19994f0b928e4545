"""How good a retargeted clip is, and whether it is good enough.

Every figure is measured on the finished clip against the source, never on a step between.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from warmstart.mocap.capture import SIDES, unit
from warmstart.mocap.ground import Contacts, Soles
from warmstart.mocap.kinematics import Chain, Frames

SUNK = 0.02
"""A frame counts as sunk when a point of the body is this far under the floor (m)."""
BONES = tuple(
    (side + a, side + b)
    for side in SIDES
    for a, b in (("Hip", "Knee"), ("Knee", "Ankle"), ("Shoulder", "Elbow"), ("Elbow", "Wrist"))
)


@dataclass(frozen=True)
class Limits:
    """Bounds beyond which a clip is rejected."""

    joint_error: float = 0.06
    """Mean distance of joints from their targets (m)."""
    contact_height: float = 0.02
    """Median height of a sole in contact (m)."""
    sunk_frames: float = 0.02
    """Share of frames with a point more than 2 cm under the floor."""
    skating: float = 0.15
    """Mean horizontal speed of soles in contact (m/s)."""
    jerk: float = 20000.0
    """95th percentile of the third derivative of joint positions (m/s^3)."""
    jerk_added: float = 3000.0
    """By how much it exceeds the source's (m/s^3)."""
    unevenness: float = 0.35
    """Range of the move that brings the feet to one floor (m): stairs, boxes, slopes."""
    speed: float = 25.0
    """Fastest joint (m/s): a jump of the recording."""
    duration: float = 0.25
    """Shortest clip (s)."""


@dataclass(frozen=True)
class Quality:
    """Figures of one clip; lengths in m, angles in degrees."""

    frames: int
    seconds: float
    joint_error: float
    """Mean over frames and key joints of the distance to the source on our bones' lengths."""
    joint_error_worst: float
    """95th percentile over frames of the mean over joints."""
    bone_error: float
    """Mean angle between limb bones and the source's own (degrees): no scaling enters."""
    scaled_distance: float
    """Mean distance to the source's joints scaled by leg length alone: it holds the difference of
    proportions and of joint definitions as well, which no retargeting can remove."""
    contact_share: float
    """Share of frames with a foot in contact."""
    contact_height: float
    """Median absolute height of the lowest point of feet in contact."""
    contact_height_worst: float
    """95th percentile of the same."""
    skating: float
    """Mean horizontal speed of soles in contact (m/s)."""
    sunk_frames: float
    """Share of frames with a point of the body more than 2 cm under the floor."""
    deepest: float
    """Deepest point under the floor (m)."""
    jerk: float
    """95th percentile over frames and joints (m/s^3)."""
    jerk_source: float
    """The same of the source's targets."""
    speed: float
    """Fastest joint (m/s)."""
    moved: float
    """Range of the vertical move of the whole athlete (m)."""

    def reasons(self, limits: Limits | None = None) -> list[str]:
        """Why the clip is rejected; empty when it is good."""
        limits = limits or Limits()
        checks = (
            ("joints {:.1f} cm from the source", self.joint_error, limits.joint_error, 100),
            ("soles in contact {:.1f} cm high", self.contact_height, limits.contact_height, 100),
            ("{:.1f} % of frames under the floor", self.sunk_frames, limits.sunk_frames, 100),
            ("feet slide at {:.0f} cm/s", self.skating, limits.skating, 100),
            ("jerk of {:.0f} m/s^3", self.jerk, limits.jerk, 1),
            ("{:.0f} m/s^3 jerkier", self.jerk - self.jerk_source, limits.jerk_added, 1),
            ("floor uneven by {:.0f} cm", self.moved, limits.unevenness, 100),
            ("a joint at {:.0f} m/s", self.speed, limits.speed, 1),
        )
        found = [text.format(value * unit) for text, value, bound, unit in checks if value > bound]
        if self.seconds < limits.duration:
            found.append(f"only {self.seconds:.2f} s long")
        return found

    def to_json(self) -> dict[str, float]:
        return asdict(self)


def measure(
    chain: Chain,
    frames: Frames,
    fps: float,
    contacts: Contacts,
    targets: dict[str, np.ndarray],
    scaled: dict[str, np.ndarray],
    moved: np.ndarray,
) -> Quality:
    """Figures of a finished motion.

    ``targets`` and ``scaled`` (joint -> (T, 3)) are of the source before it was grounded; ``moved``
    (T,) is the vertical move of the whole athlete, which they are given before distances are taken.
    """
    ours = {name: frames.origin[:, chain.index[name]] for name in targets}
    lift = moved[:, None] * np.array([0.0, 0.0, 1.0])
    error = np.stack([np.linalg.norm(ours[n] - targets[n] - lift, axis=1) for n in targets], 1)
    far = [np.linalg.norm(ours[n] - scaled[n] - lift, axis=1) for n in scaled if n in ours]
    cosine = [(unit(ours[b] - ours[a]) * unit(scaled[b] - scaled[a])).sum(1) for a, b in BONES]
    surface = chain.heights(frames)
    soles = Soles(chain)
    height = np.where(contacts.down, soles.heights(surface), np.inf).min(2)[contacts.foot]
    place = soles.places(frames)[..., :2]
    slide = np.linalg.norm(np.diff(place, axis=0), axis=-1) * fps
    stays = contacts.stays
    joints, source = np.stack(list(ours.values()), 1), np.stack(list(targets.values()), 1)
    low = surface.min(1)
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1) * fps
    return Quality(
        frames=len(low),
        seconds=(len(low) - 1) / fps,
        joint_error=float(error.mean()),
        joint_error_worst=float(np.percentile(error.mean(1), 95)),
        bone_error=float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean()),
        scaled_distance=float(np.mean(far)),
        contact_share=float(contacts.foot.any(1).mean()),
        contact_height=float(np.median(np.abs(height))) if len(height) else 0.0,
        contact_height_worst=float(np.percentile(np.abs(height), 95)) if len(height) else 0.0,
        skating=float(slide[stays].mean()) if stays.any() else 0.0,
        sunk_frames=float((low < -SUNK).mean()),
        deepest=float(max(0.0, -low.min())),
        jerk=_jerk(joints, fps),
        jerk_source=_jerk(source, fps),
        speed=float(speed.max()),
        moved=float(np.ptp(moved)),
    )


def _jerk(points: np.ndarray, fps: float) -> float:
    if len(points) < 4:
        return 0.0
    third = np.linalg.norm(np.diff(points, n=3, axis=0), axis=-1) * fps**3
    return float(np.percentile(third, 95))
