"""From a solution to a demonstration: certified, tracked in MuJoCo, labelled with what it achieved.

This is what ``solve`` runs after the optimiser and what made the shipped clips.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from warmstart.certificate import Certificate, certify
from warmstart.clip import Clip
from warmstart.solution import Solution
from warmstart.tracking import Tracking, track_best


@dataclass(frozen=True)
class Demonstration:
    """What became of a solution."""

    certificate: Certificate
    clip: Clip | None
    """The tracked motion; None when the gate refused the solution or it could not be simulated."""
    reason: str
    """Why it is not a demonstration; empty when it is one."""

    @property
    def passed(self) -> bool:
        """Certified, and a success by the task's own rules in MuJoCo."""
        return self.clip is not None and not self.reason


def demonstrate(
    solution: Solution,
    settings: Tracking | None = None,
    *,
    attempts: int = 3,
    threads: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Demonstration:
    """Certifies a solution and tracks it in its task.

    Raises ValueError when the solution's problem is no task.
    """
    certificate = certify(solution)
    if not certificate.passed:
        return Demonstration(certificate, None, "; ".join(certificate.failures))
    try:
        tracked = track_best(
            solution, settings, attempts=attempts, threads=threads, progress=progress
        )
    except RuntimeError as error:
        return Demonstration(certificate, None, str(error))
    clip = tracked.clip
    meta = {
        **clip.meta,
        "certified": True,
        "planned": certificate.achieved["planned"],
        "link_error": tracked.link_error,
        "root_error": tracked.root_error,
    }
    reason = ""
    if not tracked.success:
        reason = f"tracked in MuJoCo, the task calls it no success: {clip.meta['achieved']}"
    return Demonstration(certificate, replace(clip, meta=meta), reason)


def save_demonstration(found: Demonstration, clip_path: Path, certificate_path: Path) -> None:
    """Writes the certificate always, and the clip if there is one, each atomically."""
    found.certificate.to_json(certificate_path)
    if found.clip is not None:
        found.clip.save(clip_path)
