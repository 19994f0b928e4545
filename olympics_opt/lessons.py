"""``olympics-opt lessons``: a policy that learns in several lessons, from one file."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from olympics_opt.recipe import WIDTH, wrapped

if TYPE_CHECKING:
    from rl.lessons import Plan

USAGE = """usage: olympics-opt lessons PLAN --out FOLDER [--show] [options of train]

Train a policy in several lessons, one after another, each from what the one before came to.
Stopped at any moment, the same command goes on. PLAN is a TOML file or one of the project's:
"""


@dataclass(frozen=True)
class Lessons:
    """What is asked for beside options of ``train``."""

    out: Path = Path("runs/lessons")
    """Folder for the lessons' runs, what each came to (lessons.json) and the policy."""
    show: bool = False
    """Print the lessons' commands and train nothing."""


def run_lessons(args: list[str]) -> int:
    """The command. Raises what ``rl.lessons.teach`` raises."""
    from rl.lessons import load_plan, teach

    if not args or {"-h", "--help"} & set(args):
        print(_help())
        return 0 if args else 2
    if args[0].startswith("-"):
        raise ValueError("say which plan to follow first: olympics-opt lessons PLAN --out FOLDER")
    asked, extra = tyro.cli(
        Lessons, args=args[1:], prog="olympics-opt lessons PLAN", return_unknown_args=True
    )
    plan = load_plan(args[0])
    if asked.show:
        print(_commands(plan, extra))
        return 0
    teach(plan, asked.out, extra)
    return 0


def _help() -> str:
    from rl.lessons import load_plan, plan_names

    text = USAGE
    for name in plan_names():
        about = " ".join(load_plan(name).about.split())
        text += "\n" + textwrap.fill(
            f"{name}: {about}", WIDTH, initial_indent="  ", subsequent_indent="    "
        )
    text += (
        "\n\n--out FOLDER    the lessons' runs, lessons.json and policy.safetensors (runs/lessons)"
    )
    text += "\n--show          print the lessons' commands and train nothing"
    return text + "\n\nOther options are those of `olympics-opt train`, in all lessons."


def _commands(plan: Plan, extra: list[str]) -> str:
    """What the lessons are told; what only the lesson before can tell is left as it stands."""
    from rl.recipe import ROOT

    lines = []
    for number, lesson in enumerate(plan.lessons):
        words = ["olympics-opt", "train", lesson.task, *plan.options, *lesson.options, *extra]
        words += ["--init", plan.lessons[number - 1].name] if number else []
        words += ["--out", lesson.name]
        text = wrapped([word.replace("{project}", str(ROOT)) for word in words])
        lines.append(f"# {number + 1}. {lesson.name}\n{text}\n")
    return "\n".join(lines)
