"""The pages' part on verification: parity, scores by engine, distributions, one replay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from olympics_opt.report import sections
from olympics_opt.report.page import Block, Fragment, Section, Table, Text, Tile, Tiles, number
from olympics_opt.report.sections import ENGINE_NAMES, metric_table, parity_section

LINKS_SHOWN = 8
"""Of those on which the engines differ."""


def verification_sections(
    report: Mapping[str, Any], recordings: Mapping[str, Any] | None = None
) -> list[Section]:
    """Sections of a report.json of ``olympics-opt verify``; ``recordings`` by run, for replay."""
    parts = [_verdict_section(report), parity_section(report["parity"])]
    if report["results"]:
        parts += [_scores_section(report), _distribution_section(report)]
    if report.get("parting"):
        parts.append(_parting_section(report["parting"]))
    if recordings:
        parts.append(replay_of(recordings, "replay-verify"))
    parts.append(
        sections.provenance_section(
            {
                "task": report["task"],
                "policy": report["policy"],
                "policy sha256": _first(report, "policy_sha256"),
                "strength": report["strength"],
                "limits": report["limits"],
                "options": str(report["options"] or "none"),
                "trials": report["trials"],
                "seed": report["seed"],
                "commit": report["commit"],
                "hardware": report["hardware"],
                "versions": report["versions"],
            }
        )
    )
    return parts


def replay_of(recordings: Mapping[str, Any], element_id: str, title: str = "Replay") -> Section:
    """Recorded episodes in one 3-D replay, aligned in time at the decisive place."""
    from olympics_opt.report.replay import ReplayTrack, aligned, replay_html

    tracks = aligned(
        ReplayTrack.from_episode(r, ENGINE_NAMES.get(run, run)) for run, r in recordings.items()
    )
    scene = next(iter(recordings.values())).scene
    fragment = replay_html(scene, tracks, title=title, element_id=element_id)
    return Section(title, [Fragment(fragment)])


def _verdict_section(report: Mapping[str, Any]) -> Section:
    from olympics_opt.verify import verdict_text

    verdict = report["verdict"]
    tone = "bad" if not verdict["passed"] else "warn" if verdict["notes"] else "good"
    blocks: list[Block] = [Text(verdict_text(report), "verdict", tone)]
    tiles = [
        Tile(
            f"success, {ENGINE_NAMES[run]}",
            sections.metric_text(result["metrics"].get("success")).split(" [")[0] + " %",
            f"{result['trials']} trials",
        )
        for run, result in report["results"].items()
    ]
    for name, run in (("kept", "drake"), ("kept_half_step", "mujoco-half-step")):
        if verdict.get(name) is not None:
            tiles.append(Tile(f"kept in {ENGINE_NAMES[run]}", f"{100 * verdict[name]:.0f} %"))
    return Section("Verdict", [*blocks, *([Tiles(tiles)] if tiles else [])])


def _scores_section(report: Mapping[str, Any]) -> Section:
    results = {ENGINE_NAMES[run]: r for run, r in report["results"].items()}
    rows = [
        [
            ENGINE_NAMES[run],
            f"{100 * d['difference']:+.1f} points",
            f"[{100 * d['low']:+.1f}, {100 * d['high']:+.1f}]",
        ]
        for run, d in report["success"].items()
    ]
    health = [
        [ENGINE_NAMES[run], r.get("overflow", 0), r.get("nan_worlds", 0)]
        for run, r in report["results"].items()
    ]
    return Section(
        "Scores",
        [
            metric_table(results),
            Table(
                ["success against MuJoCo", "difference", "95 % interval"],
                rows,
                "Newcombe's interval of the difference of two rates.",
            ),
            Table(["run", "overflow", "NaN worlds"], health, "Worlds whose numbers failed."),
        ],
        "The same policy, the same task code, the same trials; only the engine or its time step "
        "differs. The half step shows how much of a difference is MuJoCo's own discretisation.",
    )


def _distribution_section(report: Mapping[str, Any]) -> Section:
    rows = [
        [
            ENGINE_NAMES[run],
            c["metric"].replace("_", " "),
            c["reference_mean"],
            c["other_mean"],
            c["permutation_p"],
            c["ks"],
            c["ks_p"],
        ]
        for run, comparisons in report["comparisons"].items()
        for c in comparisons
    ]
    first = next(iter(report["results"].values()))
    units = {name: metric["unit"] for name, metric in first["metrics"].items()}
    samples = {
        run: {k: np.asarray(v, dtype=float) for k, v in values.items()}
        for run, values in report["samples"].items()
    }
    table = Table(
        ["run", "metric", "MuJoCo", "this run", "p, equal means", "KS distance", "p, KS"],
        rows,
        "Two-sided permutation test of the means, Kolmogorov-Smirnov test of the distributions.",
    )
    return Section(
        "Distributions", [sections.distribution_plots(samples, units), *([table] if rows else [])]
    )


def _parting_section(parting: Mapping[str, Any]) -> Section:
    forces = [
        [
            f["athlete"],
            f["link"],
            f"{100 * f['touching']:.0f} %",
            f"{f['other']:.0f}, {f['mujoco']:.0f}",
            f"{f['other_peak']:.0f}, {f['mujoco_peak']:.0f}",
            f"{f['blame']:.2f}",
        ]
        for f in parting["forces"][:LINKS_SHOWN]
    ]
    worst = [
        [
            w["world"],
            f"{w['seconds']:.2f} s",
            f"{w['velocity']:.2f} rad/s",
            w["athlete"],
            w["link"],
            f"{w['other']:.0f}, {w['mujoco']:.0f}",
        ]
        for w in parting["worst"]
    ]
    return Section(
        "Where the engines part",
        [
            Table(
                ["athlete", "link", "touches", "mean N", "99 % N", "correlation"],
                forces,
                "The ground on each link, Drake's force and MuJoCo's, in the substep in which it "
                "is largest (a firm ground peaks higher for the same impulse); and how the "
                "difference goes with that of the joints' velocities.",
            ),
            Table(
                ["world", "time", "joints apart", "athlete", "link", "N"],
                worst,
                "The steps after which the joints' velocities differ most, and the link on which "
                "the forces then do.",
            ),
        ],
        f"{parting['steps']} control steps of Drake's episodes, each played again by MuJoCo at "
        f"1/{1.0 / parting['timestep']:.0f} s from the same state with the same targets. Then the "
        f"joints' velocities differ by {parting['velocity']:.2f} rad/s rms in the median, "
        f"{parting['velocity_p95']:.2f} in one step of twenty.",
    )


def _first(report: Mapping[str, Any], field: str) -> str:
    return next((number(r.get(field)) for r in report["results"].values()), "–")
