"""A policy that learns in several lessons, one run after another, from one file.

What a run cannot change while it learns - its discount, what is paid, how long a rollout is - may
differ from lesson to lesson. A plan is a TOML file: the ``task``, ``options`` of ``train`` that
hold in all lessons, and ``[[lessons]]`` with a ``name`` and the ``options`` of each. Every lesson
begins with the policy that the one before came to, its critic too. A lesson may name a ``task`` of
its own, but for the last: who is to hurdle may learn to run as a long jumper (``rl.warm_start``;
the critic begins anew). ``{curriculum/h_max}`` in its options is what that column of progress.csv
had come to in the lesson before (the mean of its last values), and ``{project}`` the folder of this
project. Plans of ours are in ``rl/plans``.

A plan that ``extends`` another, one of ours or a file beside it, is that one but for what it says
itself: its options stand above the other's, a lesson's above those of the other's lesson with that
name, lessons with other names follow, and it begins with the lesson that ``first`` names.
"""

from __future__ import annotations

import gc
import json
import re
import shlex
import tomllib
from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from statistics import fmean
from typing import Any

import torch

from rl.checkpoint import checkpoints, read_state
from rl.config import APART, parse_args
from rl.policy import export_policy, read_policy
from rl.recipe import ROOT, by_option, train_words
from rl.runlog import read_progress
from rl.train import train
from rl.until import GROUPS, ITERATIONS
from sports.registry import task_names
from warmstart import atomic

PLANS = Path(__file__).with_name("plans")
OURS = ("--out", "--resume", "--no-resume")
"""Options that lessons set themselves."""
RECORD = "lessons.json"
POLICY = "policy.safetensors"


@dataclass(frozen=True)
class Lesson:
    """One run of several."""

    name: str
    options: tuple[str, ...]
    """Of ``train``; ``{NAME}`` stands for what is known when it begins."""
    task: str
    """The plan's, or another."""


@dataclass(frozen=True)
class Plan:
    """What is learned, and in which order."""

    task: str
    """Of the policy that comes of it."""
    about: str
    """In words, for people."""
    options: tuple[str, ...]
    """Of all lessons."""
    lessons: tuple[Lesson, ...]


@dataclass(frozen=True)
class Ended:
    """What a lesson came to."""

    name: str
    samples: int
    minutes: float
    stopped_by: str
    """As in ``rl.train.RunSummary``."""
    levels: dict[str, float]
    """Mean of the last values of the columns of ``rl.until.GROUPS``."""

    def sentence(self) -> str:
        """For the screen."""
        return (
            f"{self.name}: {self.samples:,} samples, {self.minutes:.1f} minutes, stopped by "
            f"{self.stopped_by}"
        )


# -- plans --------------------------------------------------------------------------------------


def plan_names() -> list[str]:
    """Plans that the project brings."""
    return sorted(path.stem for path in PLANS.glob("*.toml"))


def load_plan(source: str) -> Plan:
    """A plan by its name, or from a file. Raises ValueError for what is none."""
    path = _path(source, Path())
    plan = _read(path, ())
    for mistake in _mistakes(plan):
        raise ValueError(f"{path}: {mistake}")
    return plan


def _path(source: str, beside: Path) -> Path:
    """Of a plan of ours, or a file beside another plan."""
    path = PLANS / f"{source}.toml" if source in plan_names() else beside / source
    if not path.is_file():
        known = ", ".join(plan_names())
        raise ValueError(f"there is no plan '{source}': give a TOML file or one of {known}")
    return path


def _read(path: Path, behind: tuple[Path, ...]) -> Plan:
    """A plan, with what those that it extends say; ``behind`` are the plans that extend it."""
    try:
        data = tomllib.loads(path.read_text())
        if path.resolve() in behind:
            raise ValueError(f"{path} extends itself")
        if "extends" in data:
            base = _read(_path(str(data["extends"]), path.parent), (*behind, path.resolve()))
            data = {"task": base.task, "about": base.about, "lessons": []} | data
        else:
            base = Plan(str(data["task"]), "", (), ())
        task, about = str(data["task"]), str(data.get("about", "")).strip()
        old = {lesson.name: lesson for lesson in base.lessons}
        own = [_lesson(x, old.get(str(x["name"])), task, path) for x in data["lessons"]]
        options = _above(_words(data, path), base.options)
    except (tomllib.TOMLDecodeError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path} is no plan ({error}): it needs a task and [[lessons]], each with a name and "
            "options in quotes"
        ) from None
    said = {lesson.name: lesson for lesson in own}
    lessons = [said.get(lesson.name, lesson) for lesson in base.lessons]
    lessons += [lesson for lesson in own if lesson.name not in old]
    if "first" in data:
        lessons = _from(str(data["first"]), lessons, path, "extends" in data)
    return Plan(task, about, options, tuple(lessons))


def _from(first: str, lessons: list[Lesson], path: Path, extends: bool) -> list[Lesson]:
    """The lessons of a plan from that one on."""
    names = [lesson.name for lesson in lessons]
    if not extends:
        raise ValueError(f"{path} leaves out lessons before '{first}', and extends no plan")
    if first not in names:
        raise ValueError(f"{path} begins with '{first}', and has no lesson of that name")
    return lessons[names.index(first) :]


def _lesson(data: dict[str, Any], old: Lesson | None, task: str, path: Path) -> Lesson:
    """One of a plan; ``old`` is that with its name in the plan which that one extends."""
    words = _words(data, path)
    if old is not None:
        task, words = old.task, _above(words, old.options)
    return Lesson(str(data["name"]), words, str(data.get("task", task)))


def _above(words: Sequence[str], others: Sequence[str]) -> tuple[str, ...]:
    """Options and those of ``others`` that are not among them, which stand before."""
    own = {_option(group) for group in by_option(words)}
    kept = [group for group in by_option(others) if _option(group) not in own]
    return (*chain.from_iterable(kept), *words)


def _option(group: Sequence[str]) -> str:
    return group[0].partition("=")[0]


def _words(data: dict[str, Any], path: Path) -> tuple[str, ...]:
    try:
        return tuple(shlex.split(data.get("options", "")))
    except ValueError as error:
        raise ValueError(f"{path} is no plan: options {data['options']!r} ({error})") from None


def _mistakes(plan: Plan) -> Iterator[str]:
    for task in dict.fromkeys((plan.task, *(lesson.task for lesson in plan.lessons))):
        if task not in (*task_names(), *APART):
            yield f"there is no task '{task}'"
    if not plan.lessons:
        yield "there is no lesson in it"
    elif (last := plan.lessons[-1].task) != plan.task:
        yield f"its task is '{plan.task}', and its last lesson is of '{last}'"
    names = [lesson.name for lesson in plan.lessons]
    if len(set(names)) < len(names):
        yield "two lessons have the same name"
    for name in names:
        if not re.fullmatch(r"[\w-]+", name):
            yield f"the name '{name}' must do for a folder: letters, digits, _ and -"
    yield from _ours([*plan.options, *(word for x in plan.lessons for word in x.options)])


def _ours(words: Sequence[str]) -> Iterator[str]:
    """What is wrong with options that lessons set themselves."""
    for word in words:
        if word.partition("=")[0] in OURS:
            yield f"leave {word} out: lessons have a folder each, and go on by themselves"


def filled(words: Sequence[str], known: dict[str, str]) -> list[str]:
    """The words with what ``{NAME}`` stands for in them. Raises ValueError for what is unknown."""

    def value(found: re.Match[str]) -> str:
        if found[1] not in known:
            raise ValueError(
                f"{found[0]} is not known when that lesson begins; known are: {', '.join(known)}"
            )
        return known[found[1]]

    return [re.sub(r"\{([\w/]+)\}", value, word) for word in words]


def lesson_words(
    plan: Plan, number: int, extra: Sequence[str], before: Ended | None, out: Path
) -> list[str]:
    """What ``train`` is told in a lesson, its task first, but for ``--out``.

    Args:
        plan: whose lesson it is.
        number: from 0.
        extra: options that stand above the plan's.
        before: what the lesson before came to.
        out: folder of all lessons.
    """
    lesson, known = plan.lessons[number], {"project": str(ROOT)}
    start: list[str] = []
    if before is not None:
        known |= {name: f"{value:.4g}" for name, value in before.levels.items()}
        start = ["--init", str(folder(plan, number - 1, out))]
    words = filled([*plan.options, *lesson.options], known)
    return [lesson.task, *words, *extra, *start]  # of options told twice the last counts


def folder(plan: Plan, number: int, out: Path) -> Path:
    """Of a lesson's run."""
    return out / f"{number + 1}_{plan.lessons[number].name}"


# -- learning -----------------------------------------------------------------------------------


def teach(plan: Plan, out: Path, extra: Sequence[str] = ()) -> list[Ended]:
    """Trains lesson after lesson, in this process; one that has ended is not begun again.

    Args:
        plan: what to learn.
        out: a folder for each lesson, ``lessons.json`` and, when all have ended, the policy.
        extra: options of ``train`` for all lessons, above the plan's.

    Returns what each lesson came to, fewer than the plan has where a signal ended one.
    Raises ValueError for options that cannot be and a folder with lessons of another plan, and
    what ``train`` raises.
    """
    for mistake in _ours(extra):
        raise ValueError(mistake)
    ended = _ended(plan, out)
    quiet = False
    for lesson in ended:
        print(f"{lesson.sentence()} (before)", flush=True)
    for number in range(len(ended), len(plan.lessons)):
        name, place = plan.lessons[number].name, folder(plan, number, out)
        words = lesson_words(plan, number, extra, ended[-1] if ended else None, out)
        config = parse_args([*words, "--out", str(place), "--resume"], "lessons")
        quiet = config.quiet
        _tell(quiet, f"lesson {number + 1} of {len(plan.lessons)}: {name}")
        summary = train(config)
        _free()
        if summary.stopped_by == "signal":
            _tell(quiet, "stopped; the same command goes on")
            return ended
        minutes = round(summary.minutes, 3)
        ended.append(Ended(name, summary.samples, minutes, summary.stopped_by, levels(place)))
        _tell(quiet, ended[-1].sentence())
        atomic.write_json(out / RECORD, [asdict(lesson) for lesson in ended])
    policy = read_policy(folder(plan, len(plan.lessons) - 1, out), plan.task)
    policy.metadata["lessons"] = [_told(plan, k, ended[k], out) for k in range(len(ended))]
    export_policy(policy, out / POLICY)
    minutes = sum(lesson.minutes for lesson in ended)
    samples = sum(lesson.samples for lesson in ended)
    _tell(quiet, f"{samples:,} samples and {minutes:.1f} minutes in all: {out / POLICY}")
    return ended


def levels(run: Path) -> dict[str, float]:
    """What a run's figures of ``rl.until.GROUPS`` had come to: means of their last values."""
    values: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=ITERATIONS))
    for row in read_progress(run):
        for name, value in row.items():
            if name.startswith(GROUPS) and value is not None:
                values[name].append(value)
    return {name: fmean(last) for name, last in values.items()}


def _told(plan: Plan, number: int, lesson: Ended, out: Path) -> dict[str, Any]:
    """For a card: what a lesson came to, and the options of ``train`` that it had but for
    ``--init``, which is the lesson before."""
    state = read_state(checkpoints(folder(plan, number, out))[-1])
    words = train_words(state["card"], init=number == 0)
    told = {"name": lesson.name, "task": plan.lessons[number].task, "samples": lesson.samples}
    told |= {"minutes": lesson.minutes, "stopped_by": lesson.stopped_by}
    return told | {"options": shlex.join(words)}


def _ended(plan: Plan, out: Path) -> list[Ended]:
    """The lessons that have ended. Raises ValueError where they are another plan's."""
    path = out / RECORD
    if not path.is_file():
        return []
    try:
        data = json.loads(path.read_text())
        ended = [Ended(**one) for one in data]
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path} cannot be read ({error})") from None
    names = [lesson.name for lesson in plan.lessons]
    if [lesson.name for lesson in ended] != names[: len(ended)]:
        raise ValueError(f"{out} holds the lessons of another plan: give another --out")
    return ended


def _tell(quiet: bool, text: str) -> None:
    if not quiet:
        print(text, flush=True)


def _free() -> None:
    """Gives back what a lesson held on the device before the next one begins."""
    gc.collect()
    torch.cuda.empty_cache()  # which does nothing where none is in use
