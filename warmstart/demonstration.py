"""From a solution to a demonstration: certified, tracked in MuJoCo, labelled with what it achieved.

This is what made the shipped clips: ``python -m warmstart.demonstration SOLUTION.npz... --out DIR``
writes, for each solution that passes, ``PROBLEM_ASKED_STRENGTH[_STYLE].npz`` and its certificate
beside it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from warmstart.certificate import Certificate, certify
from warmstart.clip import Clip
from warmstart.outcome import OUTCOMES
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
    certificate: Certificate | None = None,
    attempts: int = 3,
    threads: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Demonstration:
    """Certifies a solution and tracks it in its task.

    A ``certificate`` of the solution, where there is one already, is taken as it is. Raises
    ValueError when the solution's problem is no task.
    """
    certificate = certificate or certify(solution)
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
        "planned": certificate.achieved.get("planned"),
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Makes demonstrations of solution files; 1 when one of them failed, 2 for a bad file."""
    parser = argparse.ArgumentParser(prog="python -m warmstart.demonstration", description=__doc__)
    parser.add_argument("solutions", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--attempts", type=int, default=5)
    options = parser.parse_args(arguments)
    failed = 0
    for path in options.solutions:
        try:
            solution = Solution.load(path)
            found = demonstrate(solution, attempts=options.attempts)
            asked = solution.asked[OUTCOMES[solution.problem].field]
        except (ValueError, KeyError) as error:
            print(f"{path}: {error}", file=sys.stderr)
            return 2
        name = f"{solution.problem}_{asked:g}m_{solution.strength}"
        if solution.stats.get("style", "tuck") != "tuck":
            name += f"_{solution.stats['style']}"
        if found.passed:
            out = options.out
            save_demonstration(found, out / f"{name}.npz", out / f"{name}.json")
            assert found.clip is not None
            print(f"{name}: {found.clip.meta['achieved']}")
        else:
            failed += 1
            print(f"{name}: no demonstration: {found.reason}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
