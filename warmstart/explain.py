"""Why a motion is a demonstration or not: which check failed, by how much, and what to try.

Reads what ``solve``, its sweeps and ``solve --all`` leave in a folder, results and certificates;
computes nothing anew but the verdict of each certificate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from warmstart.certificate import Certificate, Check
from warmstart.job import Result, read_result

ADVICE: dict[str, str] = {
    "nlp violation": "the solver stopped early: allow more iterations (max_iterations), or start "
    "from a neighbour (a sweep with --continuation)",
    "velocity is the rate": "the file was changed after it was solved: solve it again",
    "acceleration is the rate": "the file was changed after it was solved: solve it again",
    "base force residual": "the grid is too coarse between its knots: raise detail",
    "base moment residual": "the grid is too coarse between its knots: raise detail",
    "inverse dynamics": "the two engines disagree about the body: compare its models first "
    "(verify prints the parity table)",
    "planned torque": "the motion needs more torque than there is: ask for less, or for strength "
    "paper",
    "needed torque": "the torque between the knots is over its limit: raise detail, or ask for "
    "less",
    "friction": "the foot would slip: ask for less, or raise detail",
    "pulling contact force": "the ground would have to pull between two knots: raise detail",
    "height of loaded contacts": "a loaded point floats or sinks between two knots: raise detail",
    "speed of loaded contacts": "a loaded point slides between two knots: raise detail",
    "depth below the ground": "a limb dips into the ground between two knots: raise detail",
    "depth of self-contact": "two limbs pass through each other between two knots: raise detail, "
    "or start from another neighbour",
    "beyond a joint limit": "a joint leaves its range between two knots: raise detail",
    "planned outcome": "the motion does not do what its sport asks for: solve it again",
    "planned ": "between the knots the motion is off what was asked: raise detail",
    "clearance over the bar": "the body touches the bar between two knots: raise clearance or "
    "detail",
    "foremost contact": "the take-off is a foul: raise board",
    "touch-down": "the impact of the foot is not possible: raise detail, or start from a neighbour",
    "replay in mujoco: lowest but feet": "the athlete falls in the replay: ask for less",
    "replay in drake: lowest but feet": "the athlete falls in the replay: ask for less",
    "replay in mujoco: opponent": "the weapon does not touch the opponent: raise detail",
    "replay in drake: opponent": "the weapon does not touch the opponent: raise detail",
    "replay in": "replayed, the motion misses: raise detail, so that the torques between "
    "the knots are closer to those that are needed",
}
"""What to try, by the beginning of a check's name."""
ELSE = "raise detail; if that does not help, ask for less"
BY_STATUS = {
    "infeasible": "ask for less, allow more iterations (max_iterations), or come from a value that "
    "works: a sweep that ends here, with --continuation",
    "untracked": "the motion is possible but hard to follow: solve again with more detail, or ask "
    "for a little less",
    "crashed": "run the same command again, it takes up what is missing; alone and with --debug it "
    "shows where it fails",
}
_CERTIFICATE = ".certificate.json"


@dataclass(frozen=True)
class Case:
    """One motion, or attempt at one, and what speaks against it."""

    name: str
    problem: str
    asked: str
    """The prescribed outcome in words."""
    status: str
    reason: str
    """In words, what the failed checks do not tell."""
    failed: tuple[Check, ...]
    checks: int
    """How many checks there are in the certificate; 0 without one."""

    @property
    def passed(self) -> bool:
        """Nothing speaks against it."""
        return self.status in ("certified", "solved")

    def lines(self) -> list[str]:
        """The case in words: verdict, what failed by how much, what to try."""
        of = f", {self.checks - len(self.failed)} of {self.checks} checks" if self.checks else ""
        out = [f"{self.name}: {self.status}{of} ({self.problem}, {self.asked})"]
        for check in self.failed:
            note = f", {check.note}" if check.note else ""
            out.append(f"  {check.name}: {by_how_much(check)}{note}")
        if self.reason:
            out.append(f"  {self.reason}")
        return out + [f"  try: {advice}" for advice in self.advice]

    @property
    def advice(self) -> list[str]:
        """What to try, each only once."""
        if self.failed:
            return list(dict.fromkeys(advice_for(check) for check in self.failed))
        return [BY_STATUS[self.status]] if self.status in BY_STATUS else []


def explain(folder: str | Path) -> list[Case]:
    """Every motion and attempt in a folder and its immediate subfolders, by name.

    Raises ValueError when there is no such folder, nothing to explain, or a broken certificate.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"no folder at {folder}")
    files = sorted([*folder.glob("*.json"), *folder.glob("*/*.json")])
    results = {path: found for path in files if (found := read_result(path)) is not None}
    cases, told = [], set()
    for path, result in results.items():
        beside = [path.with_name(f"{path.stem}{_CERTIFICATE}"), path.with_name("certificate.json")]
        proof = next((p for p in beside if p.is_file()), None)
        told.add(proof)
        if result.status in ("infeasible", "crashed"):
            proof = None  # of an earlier attempt
        cases.append(_case(_name(path, folder), result, proof))
    for path in files:  # certificates without a result beside them, such as those that are shipped
        if path not in told and path not in results and '"checks"' in path.read_text():
            cases.append(_case(_name(path, folder), None, path))
    if not cases:
        raise ValueError(f"{folder} holds no result of 'solve' and no certificate")
    return sorted(cases, key=lambda case: case.name)


def by_how_much(check: Check) -> str:
    """How far a figure is outside its limit, in words."""
    if not math.isfinite(check.value):
        return "could not be computed"
    unit = f" {check.unit}" if check.unit else ""
    limit = f"must be {check.sense} {check.limit:.3g}"
    if not math.isfinite(check.limit):
        return f"is {check.value:.4g}{unit}"
    off = abs(check.value - check.limit)
    share = f"{check.value / check.limit:.3g} times it" if check.limit > 0 < check.value else ""
    return f"is {check.value:.4g}{unit}, {limit}: {off:.3g} off" + (f", {share}" if share else "")


def advice_for(check: Check) -> str:
    """What to try about a failed check."""
    return next((text for head, text in ADVICE.items() if check.name.startswith(head)), ELSE)


def _name(path: Path, folder: Path) -> str:
    name = path.stem.removesuffix(".certificate")
    if name in ("solution", "certificate"):
        name = path.parent.name
    elif path.parent != folder:
        name = f"{path.parent.name}/{name}"
    return name


def _case(name: str, result: Result | None, proof: Path | None) -> Case:
    certificate = Certificate.from_json(proof) if proof is not None else None
    failed: tuple[Check, ...] = ()
    reason = result.reason if result is not None else ""
    if certificate is not None:
        failed = tuple(c for c in certificate.checks if not c.passed)
        if failed:
            reason = "; ".join(certificate.stats.get("not computed", ()))
        elif not certificate.passed:
            reason = "; ".join(certificate.failures) or "its limits are not those of this version"
        elif certificate.clip.get("why_not"):
            reason = f"only its plan: the clip, {certificate.clip['motion']}, is not certified: "
            reason += certificate.clip["why_not"]
    if result is not None:
        status, problem = result.status, result.problem
        if certificate is not None and not certificate.passed and result.good:
            status = "rejected"  # what the file says is not believed
        asked = "nothing asked" if result.asked is None else f"asked {result.asked:g}"
        if result.start:
            asked += f", from {result.start}"
    else:
        assert certificate is not None
        status, problem = "certified" if certificate.passed else "rejected", certificate.problem
        words = ", ".join(f"{k} {v:g}" for k, v in certificate.asked.items())
        asked = f"asked {words}" if words else "nothing asked"
    count = len(certificate.checks) if certificate is not None else 0
    return Case(name, problem, asked, status, reason, failed, count)
