"""What jumps, hurdles and lunges were asked for and what they reach in simulation: one table.

Rows are made of the shipped clips and their certificates; nothing is simulated here.
``python -m warmstart.reached --out docs/reached.md`` writes the table.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from warmstart.atomic import write_text
from warmstart.bank import demonstration_files
from warmstart.clip import Clip

OUTCOME = {
    "high_jump": "bar_height",
    "long_jump": "length",
    "hurdling": "hurdle_height",
    "fencing": "reach",
}
"""The prescribed outcome (m) by problem."""
BESIDES = {
    "high_jump": {"clearance": "over the bar {:.3f} m"},
    "long_jump": {"takeoff_speed": "take-off at {:.2f} m/s"},
    "hurdling": {
        "clearance": "over the hurdle {:.3f} m",
        "landing_speed": "lands at {:.2f} m/s",
        "next_step": "next step {:.2f} m",
        "next_speed": "at {:.2f} m/s",
    },
    "fencing": {"miss": "{:.3f} m from the target", "tip_speed": "tip at {:.2f} m/s"},
}
"""What else the clip achieved, in words; not every clip has all of it."""
HEAD = """# Asked and reached

Written by `python -m warmstart.reached` from the shipped clips and their certificates. *Planned* is
the optimised motion by itself. *In MuJoCo* is the shipped clip: jumps and strides over a hurdle
tracked in closed loop and judged by the rules of the sport, lunges played open loop. *Open loop in
Drake* is the planned torques alone, without any feedback: what a jump loses there is what tracking
is for. A long jump is measured to the nearest mark of any part of the body within 0.3 s of the
landing; 0 is an attempt that is not valid. A link that touches between two control steps
is measured where its rear was up to 0.3 m before, and the tracker knows that.

"""


@dataclass(frozen=True)
class Reached:
    """One demonstration: asked, planned and reached, in m."""

    name: str
    asked: float
    planned: float
    tracked: float
    """In MuJoCo: in closed loop, or the replay of a lunge; 0 where the task calls it a failure."""
    drake: float
    """Open loop in Drake."""
    besides: str
    """Speeds and clearances in words."""

    def cells(self) -> list[str]:
        """Of its row in the table."""
        numbers = (self.asked, self.planned, self.tracked, self.drake)
        return [self.name, *(f"{x:.3f}" for x in numbers), self.besides]


def reached(path: Path) -> Reached:
    """What the clip at ``path``, with its certificate beside it, says. Raises ValueError for a
    clip of another problem, OSError without a certificate."""
    clip = Clip.load(path)
    problem, achieved = clip.meta.get("problem"), clip.meta.get("achieved", {})
    if problem not in OUTCOME:
        raise ValueError(f"{path} is a clip of '{problem}', not of one of: {', '.join(OUTCOME)}")
    proof = json.loads(path.with_suffix(".json").read_text())["achieved"]
    name = OUTCOME[problem]
    asked = clip.meta["asked"]
    besides = BESIDES[problem].items()
    words = [text.format(achieved[key]) for key, text in besides if key in achieved]
    if "run_speed" in asked:
        words.append(f"asked to run at {asked['run_speed']:g} m/s")
    return Reached(
        path.stem,
        float(asked[name]),
        float(proof["planned"]),
        float(achieved[name]) * float(achieved.get("success", 1.0)),
        float(proof["replay_drake"]),
        ", ".join(words),
    )


def table() -> str:
    """The page: a Markdown table of all shipped jumps, hurdles and lunges."""
    rows = [reached(path) for name in OUTCOME for path in demonstration_files(name)]
    head = [
        "clip",
        "asked (m)",
        "planned (m)",
        "in MuJoCo (m)",
        "open loop in Drake (m)",
        "besides",
    ]
    lines = [head, ["---", *["---:"] * 4, "---"], *(row.cells() for row in rows)]
    return HEAD + "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Writes the page."""
    parser = argparse.ArgumentParser(prog="python -m warmstart.reached", description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    write_text(parser.parse_args(arguments).out, table())
    return 0


if __name__ == "__main__":
    sys.exit(main())
