"""Results into sections of a page: certificate, parity, metrics, motion, learning, provenance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from olympics_opt.report.page import Plots, Section, Table, Text, Tile, Tiles, Tone, number
from olympics_opt.report.plots import Plot, Series, ecdf
from sports.physics.base import GRAVITY

ENGINE_NAMES = {
    "mujoco": "MuJoCo",
    "warp": "MuJoCo Warp",
    "drake": "Drake",
    "mujoco-half-step": "MuJoCo, half step",
}


def metric_text(metric: Mapping[str, Any] | None) -> str:
    """``mean [low, high] unit`` of a metric of the result schema; rates become per cent."""
    if not metric or metric.get("mean") is None:
        return "–"
    mean, unit, interval = metric["mean"], metric.get("unit", ""), metric.get("ci95")
    scale, unit = (100.0, "%") if unit in ("1", "", "rate", "fraction") else (1.0, unit)
    text = number(scale * mean)
    if isinstance(interval, Sequence) and len(interval) == 2 and None not in interval:
        text += f" [{number(scale * interval[0])}, {number(scale * interval[1])}]"
    elif isinstance(interval, (int, float)):
        text += f" ± {number(scale * interval)}"
    return f"{text} {unit}"


def step_text(timestep: float, substeps: int) -> str:
    """``4 x 1/120 s``: how many time steps (s) an engine takes in one control step."""
    return f"{substeps} x 1/{1.0 / timestep:.0f} s"


def metric_table(results: Mapping[str, Mapping[str, Any]], caption: str = "") -> Table:
    """One column per named result, one row per metric; mean and 95 % interval.

    The last rows are the trials and, where the results say it, the engine's time step.
    """
    defined = [
        n for r in results.values() for n, m in r["metrics"].items() if m["mean"] is not None
    ]
    names = list(dict.fromkeys(defined))
    rows: list[list[object]] = [
        [_words(name), *(metric_text(r["metrics"].get(name)) for r in results.values())]
        for name in names
    ]
    rows.append(["trials", *(str(r.get("trials", "–")) for r in results.values())])
    if all("timestep" in r for r in results.values()):
        steps = (step_text(r["timestep"], r["substeps"]) for r in results.values())
        rows.append(["time steps of a control step", *steps])
    return Table(["", *results], rows, caption or "Mean and 95 % interval.")


def asked_achieved_tiles(
    asked: Mapping[str, Any], achieved: Mapping[str, Any], unit: str = ""
) -> Tiles:
    """Tiles of the prescribed outcome and of what was measured, all in ``unit``."""
    tiles = [
        Tile(f"{word}: {_words(k)}", f"{number(v)} {unit}".strip())
        for word, values in (("asked", asked), ("achieved", achieved))
        for k, v in values.items()
        if _scalar(v)
    ]
    return Tiles(tiles)


def certificate_section(certificate: Mapping[str, Any], title: str = "Certificate") -> Section:
    """Every check of a certificate with its figure and limit."""
    checks = certificate["checks"]
    passed = bool(certificate["passed"]) and all(c["passed"] for c in checks)
    clip = certificate.get("clip", {})
    verdict = Text(
        f"All {len(checks)} checks passed: this motion is a demonstration."
        if passed and not clip
        else f"All {len(checks)} checks of the plan passed. The clip is another motion, "
        f"{clip['motion']}: "
        + ("it is certified too." if clip["certified"] else f"not certified, {clip['why_not']}.")
        if passed
        else "Not certified: "
        + "; ".join(f"{c['name']} {number(c['value'])}" for c in checks if not c["passed"]),
        "verdict",
        "good" if passed else "bad",
    )
    rows = [
        [_words(c["name"]), c["value"], _limit(c), c.get("unit", ""), bool(c["passed"])]
        for c in checks
    ]
    tones: dict[int, Tone] = {i: "good" if c["passed"] else "bad" for i, c in enumerate(checks)}
    table = Table(["check", "value", "limit", "unit", "passed"], rows, tones=tones)
    replays = certificate.get("stats", {}).get("replay")
    return Section(
        title,
        [verdict, table, *([_clip_table(clip)] if clip else [])],
        "What the optimiser returned is recomputed by other code, in two engines, on a finer "
        "grid. A motion that fails one check is not used."
        + (f" Replays are {replays}." if replays else ""),
    )


def _clip_table(clip: Mapping[str, Any]) -> Table:
    """What a refined throw does in each engine, beside the plan's release (m, m/s, deg)."""
    sides = {name: clip[name] for name in ("planned", "mujoco", "drake")}
    names = dict.fromkeys(n for figures in sides.values() for n in figures)
    rows: list[list[object]] = [
        [_words(name), *(figures.get(name, "–") for figures in sides.values())] for name in names
    ]
    return Table(["the clip's throw", *sides], rows)


def parity_section(rows: Sequence[Mapping[str, Any]]) -> Section:
    """Are the two athletes the same body? ``rows``: quantity, mujoco, drake, difference, ..."""
    ok = all(r["ok"] for r in rows)
    worst = max((r["difference"] for r in rows), default=0.0)
    verdict = Text(
        f"The two models agree: largest relative difference {worst:.1e}."
        if ok
        else "The two models differ: scores of the two engines must not be compared.",
        "verdict",
        "good" if ok else "bad",
    )
    table = Table(
        ["quantity", "MuJoCo", "Drake", "unit", "relative difference", "allowed", "agree"],
        [
            [
                r["quantity"],
                r["mujoco"],
                r["drake"],
                r["unit"],
                f"{r['difference']:.1e}",
                f"{r['tolerance']:.0e}",
                bool(r["ok"]),
            ]
            for r in rows
        ],
        tones={i: "good" if r["ok"] else "bad" for i, r in enumerate(rows)},
    )
    return Section(
        "Parity of the models",
        [verdict, table],
        "Before any score is compared: do MuJoCo and Drake simulate the same body?",
    )


def distribution_plots(samples: Mapping[str, Mapping[str, np.ndarray]], unit: Mapping[str, str]):
    """Empirical distribution of each metric that varies, one line per engine.

    ``samples``: engine -> metric -> (trials,) values.
    """
    names = list(dict.fromkeys(m for s in samples.values() for m in s))
    plots = []
    for name in names:
        values = {e: np.asarray(s[name], dtype=float) for e, s in samples.items() if name in s}
        pooled = np.concatenate(list(values.values()))
        pooled = pooled[np.isfinite(pooled)]
        if len(np.unique(pooled)) <= 2:  # a success rate: the table says it all
            continue
        lines = [ecdf(ENGINE_NAMES.get(e, e), v) for e, v in values.items()]
        label = f"{_words(name)} ({unit[name]})" if unit.get(name) else _words(name)
        title = _words(name).capitalize()
        plots.append(Plot(title, label, "share of trials", lines, y_range=(0.0, 1.0)))
    return Plots(plots)


def motion_plots(recording: Any) -> Plots:
    """Plots over time of a recorded episode.

    Uses ``qpos (T, nq), qvel (T, nv), ground_force (T, A, B, 3), terms {name: (T, A)}, dt`` and
    ``scene``; of the first agent.
    """
    qpos, qvel = np.asarray(recording.qpos), np.asarray(recording.qvel)
    time = np.arange(len(qpos)) * float(recording.dt)
    plots = body_plots(time, qpos, qvel).plots
    plots = [*plots, *_distance_plots(time, recording.scene, qpos)]
    force = np.asarray(recording.ground_force)
    if force.size:
        weight = recording.scene.body.mass * GRAVITY
        total = np.linalg.norm(force[:, 0].sum(axis=1), axis=-1) / weight
        plots.append(
            Plot(
                "Ground force",
                "time (s)",
                "body weights",
                [Series("ground force", time[: len(total)], total)],
                levels={"standing": 1.0},
            )
        )
    terms = {n: np.asarray(v) for n, v in recording.terms.items()}
    terms = {n: v[:, 0] if v.ndim > 1 else v for n, v in terms.items()}
    if terms:
        lines = [Series(_words(n), time[: len(v)], v) for n, v in terms.items()]
        plots.append(Plot("Reward terms", "time (s)", "reward per step", lines))
    return Plots(plots)


def body_plots(time: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> Plots:
    """Root height and speed of the first athlete over time (T,), s."""
    speed = np.asarray(qvel)[:, :3]
    return Plots(
        [
            Plot(
                "Root height",
                "time (s)",
                "height (m)",
                [Series("root height", time, np.asarray(qpos)[:, 2])],
            ),
            Plot(
                "Root speed",
                "time (s)",
                "speed (m/s)",
                [
                    Series("along the ground", time, np.linalg.norm(speed[:, :2], axis=-1)),
                    Series("upwards", time, speed[:, 2]),
                ],
                levels={"": 0.0},
            ),
        ]
    )


def _distance_plots(time: np.ndarray, scene: Any, qpos: np.ndarray) -> list[Plot]:
    """Distance along the run from the root to the scene's bar and marks (line, goal)."""
    marks = {name: np.asarray(pos) for name, pos in scene.sites.items() if name != "start"}
    for o in scene.free_objects:
        marks.setdefault(o.name, np.asarray(o.pos))
    lines = [
        Series(f"to the {_words(name)}", time, pos[0] - qpos[:, 0]) for name, pos in marks.items()
    ]
    if not lines:
        return []
    return [Plot("Distance left along the run", "time (s)", "m", lines, levels={"": 0.0})]


def learning_plots(rows: Sequence[Mapping[str, Any]], metrics: Sequence[str] = ()) -> Plots:
    """Learning curves from the rows of a run's progress.csv.

    The episode return, the named metrics (all of them if none is named) and the curriculum, over
    samples; cells without a number leave gaps.
    """
    if not rows:
        return Plots([])

    def column(name: str) -> np.ndarray:
        return np.array([math.nan if r.get(name) is None else float(r[name]) for r in rows])

    samples = column("samples")
    scale, unit = (1e6, "million") if samples.max() >= 1e6 else (1e3, "thousand")
    x, x_label = samples / scale, f"samples ({unit})"

    def plot(title: str, y_label: str, names: Sequence[str], rate: bool = False) -> Plot:
        lines = [Series(_words(n.partition("/")[2] or n), x, column(n)) for n in names]
        return Plot(title, x_label, y_label, lines, y_range=(0.0, 1.0) if rate else None)

    found = [name for name in rows[-1] if name.startswith("metrics/")]
    found = [n for n in found if not metrics or n.partition("/")[2] in metrics]
    plots = [plot("Return of an episode", "reward", ["return"])]
    for name in found:
        words = _words(name.partition("/")[2])
        plots.append(
            plot(f"{words.capitalize()} while training", words, [name], "success" in words)
        )
    curricula = [name for name in rows[-1] if name.startswith("curriculum/")]
    if any(np.ptp(column(name)) > 0 for name in curricula):
        plots.append(plot("Curriculum", "mean over worlds", curricula))
    return Plots(plots)


def provenance_section(facts: Mapping[str, Any]) -> Section:
    """Commit, versions, hardware, seeds: what is needed to make the numbers again."""
    rows: list[list[object]] = []
    for name, value in facts.items():
        if isinstance(value, Mapping):
            rows.extend([f"{_words(name)}: {k}", _text(v)] for k, v in value.items())
        else:
            rows.append([_words(name), _text(value)])
    return Section("Provenance", [Table(["", ""], rows)])


def _limit(check: Mapping[str, Any]) -> str:
    sense = {"<=": "≤ ", ">=": "≥ "}.get(check.get("sense", ""), "")
    return "recorded" if check["limit"] is None else f"{sense}{number(check['limit'])}"


def _text(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return ", ".join(_text(v) for v in value)
    return number(value)


def _words(name: str) -> str:
    return name.replace("_", " ")


def _scalar(value: Any) -> bool:
    return isinstance(value, (int, float, str)) and not isinstance(value, bool)
