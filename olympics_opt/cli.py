"""The command line: ``olympics-opt COMMAND``. Light to import; a command loads what it needs.

Exit codes: 0 done, 1 the thing was checked and did not pass (``verify``), 2 a mistake of the
user, told in one sentence, 130 stopped with Ctrl-C. ``--debug`` shows the traceback of a mistake.

Options of a problem or task (``--problem.bar-height 1.2``, ``--task.bar-height 1.5``) are the
fields of its config; ``olympics-opt solve high_jump --help`` lists them.
"""

from __future__ import annotations

import dataclasses
import errno
import importlib
import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import Positional, arg

from rl.polish_config import Polish
from sports.variation import Variation

Name = Annotated[str, arg(metavar="NAME")]


class UsageError(ValueError):
    """A command line that cannot be understood."""


@dataclass(frozen=True)
class List:
    """Tasks, optimisation problems, trained policies and demonstrations that are here."""

    json: bool = False
    """Print JSON instead of tables."""
    previews: Path | None = None
    """Folder for a page of every demonstration: 3-D replay, checks, curves."""


@dataclass(frozen=True)
class Recipe:
    """Print the commands that a trained policy came from, with every setting, from its card."""

    name: Positional[Annotated[str, arg(metavar="TASK")]]
    """Sport, or ``tracking`` or ``prior``."""
    policy: str = "pretrained"
    """A run folder, a policy file, or ``pretrained[:ALGO[-STRENGTH]]``."""


@dataclass(frozen=True)
class Solve:
    """Optimise a motion, certify it and track it in MuJoCo; or a range of them; or all problems.

    Writes demo.npz (the motion), certificate.json and preview.html. An infeasible problem ends
    with the name of the constraint that stopped it; ``--explain`` shows reasons again later.
    Sweeps and ``--all`` write a table (JSON) and, started again, go on where they were stopped.
    """

    name: Positional[Annotated[str, arg(metavar="PROBLEM")]] = ""
    """Optimisation problem; see ``olympics-opt list``."""
    out: Path | None = None
    """Folder for the results."""
    sweep: str | None = None
    """Solve for several values of one option, in parallel: ``bar-height=0.8:1.5:8`` (first,
    last, count)."""
    continuation: bool = False
    """Take the values of a sweep one after another, each from the nearest motion found before;
    else each has its own start, and only what then fails is tried from a neighbour."""
    all: bool = False
    """Solve every registered problem at its defaults, with a second opinion where one applies."""
    explain: Path | None = None
    """Tell of every result in this folder which check failed, by how much and what to try."""
    processes: int = 2
    """Worker processes of a sweep and of ``--all``."""
    cluster: str | None = None
    """Work on Ray instead of processes: ``local`` (started here), ``auto`` (the cluster of this
    machine) or an address such as ``ray://HOST:10001``; needs the extra ``cluster``."""
    track: bool = True
    """Follow the motion in MuJoCo with feedback, which makes it a demonstration to learn from."""
    second_opinion: bool = False
    """Ask Drake's MathematicalProgram and SNOPT about the take-off too (half a minute); the answer
    goes into certificate.json and preview.html."""


@dataclass(frozen=True)
class Export:
    """Make a policy file of a run: the actor (safetensors) and its card (JSON)."""

    run: Positional[Annotated[Path, arg(metavar="RUN")]]
    """Folder of the run, of which the last checkpoint is taken; a frozen opponent in it,
    ``RUN@SAMPLES``; or a policy file."""
    out: Path
    """The policy file, FILE.safetensors; the card is FILE.json beside it."""
    mean: tuple[Path, ...] = ()
    """Other runs or policy files of the same kind, with whose weights RUN's are averaged: states
    of one run (``RUN/policies/*.safetensors`` of ``train --keep-policies``) or runs that began
    alike. Often better than each."""
    shares: tuple[float, ...] = ()
    """In the mean, of RUN and of each of ``--mean``, of any sum; by default all alike."""
    critic: bool = False
    """Keep the critic too, so that fine-tuning (``train --init``) need not begin without one."""
    precision: Literal["float16", "int8"] = "float16"
    """Of the weights. int8 takes half the room; evaluate what you export with it."""
    fit: bool = True
    """Round to int8 so that the actions change least where the policy comes in episodes of its
    task, which are played for it (seconds to a minute), instead of each weight by itself."""
    looks: str = ""
    """What its motion looks like, in words, for the card."""
    result: Path | None = None
    """A JSON file that ``evaluate`` wrote of this run or of its export: its metrics go into the
    card instead of those of the last training episodes."""


@dataclass(frozen=True)
class Evaluate:
    """Play episodes with a policy and write their metrics with 95 % intervals."""

    name: Positional[Annotated[str, arg(metavar="TASK")]]
    """Sport; see ``olympics-opt list``."""
    policy: str
    """A run folder, a policy file, or ``pretrained[:ALGO[-STRENGTH]]``."""
    out: Path
    """JSON file for the result."""
    engine: Literal["mujoco", "warp", "drake"] = "mujoco"
    """Physics engine; ``warp`` needs a GPU."""
    trials: int = 200
    """Episodes to play."""
    seed: int = 0
    """Seed of all randomness."""
    worlds: int | None = None
    """Worlds simulated at a time; by default as many as suit the engine."""
    processes: int = 2
    """Worker processes for the ``drake`` engine."""
    strength: Literal["paper", "human"] | None = None
    """Strength of the athlete; by default the one the policy was trained with."""
    limits: Literal["paper", "anatomical"] | None = None
    """Joint ranges; by default those the policy was trained with."""
    felt_damping: bool = False
    """In ``mujoco`` and ``warp``, let contacts feel the joints' damping, as Drake's do: a quick
    guess of what Drake will say. Like the next four options: the result says so, and does not
    compare with the others."""
    timestep_divisor: int = 1
    """2 halves the physics time step of ``mujoco`` and ``warp`` at the same control rate."""
    vary: bool = False
    """In ``mujoco`` and ``warp``, play in worlds that differ, as in training."""
    variation: Variation = field(default_factory=Variation)
    """How they do, and how widely."""
    like_drake: bool = False
    """In ``mujoco`` and ``warp``, play in worlds that come as near to Drake as MuJoCo's do, as
    ``train --like-drake`` does: a quick guess of what Drake will say, right about falls and jumps,
    too gloomy where precision decides (docs/physics.md, "Feet that creep")."""
    likeness: Path | None = None
    """Print how human the motion looks beside the score: ``reference`` compares it with the shipped
    figures of people, a clip library with its held-out clips (``olympics-opt likeness``)."""


@dataclass(frozen=True)
class Verify:
    """Does a result hold in another engine? Compare MuJoCo with Drake and with half the step.

    Prints the parity table of the two models first, then plays the same policy in each and
    compares outcomes. Writes report.json and report.html; exit code 1 when the result does not
    hold.
    """

    name: Positional[Annotated[str, arg(metavar="TASK")]]
    """Sport; see ``olympics-opt list``."""
    policy: str
    """A run folder, a policy file, or ``pretrained[:ALGO[-STRENGTH]]``."""
    out: Path
    """Folder for the report."""
    trials: int = 100
    """Episodes on each engine."""
    seed: int = 0
    """Seed of all randomness."""
    processes: int = 2
    """Worker processes for Drake."""
    parting_steps: int = 60
    """Control steps of four worlds in Drake that MuJoCo plays once more from the same states, to
    tell where the engines part; 0 to leave that out."""
    strength: Literal["paper", "human"] | None = None
    """Strength of the athlete; by default the one the policy was trained with."""
    limits: Literal["paper", "anatomical"] | None = None
    """Joint ranges; by default those the policy was trained with."""


@dataclass(frozen=True)
class Render:
    """Draw a policy: a video of its best episode, or a sheet of 12 frames of best and median.

    The sheet needs no GL library; the video needs EGL or OSMesa unless ``--renderer software``.
    ``--all --out sheet.png`` draws every task on one picture instead.
    """

    name: Positional[Annotated[str, arg(metavar="TASK")]] = ""
    """Sport; see ``olympics-opt list``."""
    policy: str = ""
    """A run folder, a policy file, or ``pretrained[:ALGO[-STRENGTH]]``."""
    all: bool = False
    """Every task on one picture: an episode of the shipped policy where there is one, else the
    start."""
    out: Path | None = None
    """mp4 file for the video; with ``--all`` a png file."""
    sheet: Path | None = None
    """png file for the sheet, or webp or jpg for one of half the width."""
    renderer: Literal["gl", "software"] = "gl"
    """``gl`` is MuJoCo's renderer; ``software`` needs no library and is slower."""
    engine: Literal["mujoco", "warp", "drake"] = "mujoco"
    """Physics engine."""
    trials: int = 20
    """Episodes from which the best and the median are taken."""
    seed: int = 0
    """Seed of all randomness."""
    processes: int = 2
    """Worker processes for the ``drake`` engine."""
    strength: Literal["paper", "human"] | None = None
    """Strength of the athlete; by default the one the policy was trained with."""
    limits: Literal["paper", "anatomical"] | None = None
    """Joint ranges; by default those the policy was trained with."""


@dataclass(frozen=True)
class Play:
    """Watch a policy at work: in MuJoCo's viewer, or in a browser where there is no display.

    In the viewer space pauses, - and = change the speed, the right arrow steps and backspace
    begins a new episode. The browser gets a page with a 3-D replay, from this machine alone.
    """

    name: Positional[Annotated[str, arg(metavar="TASK")]]
    """Sport; see ``olympics-opt list``."""
    policy: str = ""
    """A run folder, a policy file, ``pretrained[:ALGO[-STRENGTH]]``, ``zero`` or ``random``; by
    default the policy that is shipped, else ``zero``."""
    viewer: Literal["mujoco", "browser"] | None = None
    """By default ``mujoco`` where there is a display."""
    out: Path | None = None
    """html file for the page, instead of serving it."""
    port: int = 8000
    """Of the browser's page; 0 takes a free one."""
    seed: int = 0
    """Seed of all randomness."""
    strength: Literal["paper", "human"] | None = None
    """Strength of the athlete; by default the one the policy was trained with."""
    limits: Literal["paper", "anatomical"] | None = None
    """Joint ranges; by default those the policy was trained with."""


@dataclass(frozen=True)
class Study:
    """The whole line on one sport, from optimisation to a verified policy and a report.

    Stopped at any moment, the same command continues with the stage it was in.
    """

    name: Positional[Annotated[str, arg(metavar="SPORT")]]
    """Sport with an optimisation problem and a trained policy; see ``olympics-opt list``."""
    out: Path
    """Folder for all stages and report.html."""
    policy: str = "pretrained:ppo-human"
    """Policy to fine-tune and to compare with; by default of the strength that the take-off is
    optimised for."""
    minutes: float = 4.0
    """Training time on this machine."""
    worlds: int = 64
    """Worlds simulated at a time while training."""
    trials: int = 100
    """Episodes of each policy in MuJoCo."""
    drake_trials: int = 40
    """Episodes in Drake."""
    seed: int = 0
    """Seed of all randomness."""
    processes: int = 2
    """Worker processes."""


@dataclass(frozen=True)
class Tracker:
    """How well a motion tracker follows clips, by split, archive and sport.

    Train one with ``olympics-opt train tracking --clips LIBRARY --out RUN``.
    """

    policy: str
    """A run folder or a policy file of the task ``tracking``; ``zero`` plays the clips' own poses
    as PD targets."""
    clips: tuple[Path, ...]
    """A library that ``mocap pack`` wrote, or clips (.npz) and folders of them."""
    out: Path
    """JSON file for the result."""
    split: Literal["all", "train", "held_out"] = "all"
    """Which of the clips: those that training sees, the tenth that it never sees, or all."""
    engine: Literal["mujoco", "warp", "drake"] = "mujoco"
    """Physics engine; ``warp`` needs a GPU."""
    worlds: int | None = None
    """Worlds simulated at a time; by default as many as suit the engine."""
    seed: int = 0
    """Seed of the policy ``random``."""
    strength: Literal["paper", "human"] | None = None
    """Strength of the athlete; by default the one the policy was trained with."""
    limits: Literal["paper", "anatomical"] | None = None
    """Joint ranges; by default those the policy was trained with."""


@dataclass(frozen=True)
class Likeness:
    """How human motions look: jerk, sliding, effort and distribution beside those of people.

    Without clips the shipped reference serves: figures of openly licensed recordings that no
    training saw. With ``--clips`` it is made of the held-out tenth of a library.
    """

    motions: Positional[Annotated[tuple[str, ...], arg(metavar="POLICY")]] = ()
    """Run folders, policy files, ``pretrained[:ALGO[-STRENGTH]]``, ``zero``, ``random``; or files
    and folders of recordings, clips and libraries (.npz). By default all shipped policies."""
    task: tuple[str, ...] = ()
    """Sports to play: of the shipped policies only these; by default that of a policy's card."""
    clips: tuple[Path, ...] = ()
    """A library that ``mocap pack`` wrote, or clips (.npz) and folders of them, whose held-out
    clips to compare with; by default the shipped reference."""
    trials: int = 8
    """Episodes to play with each policy."""
    out: Path | None = None
    """JSON file for the panel, or a folder for several (``likeness_NAME.json``)."""
    chart: Path | None = None
    """png or svg file for a chart of all panels beside the range of people."""
    seed: int = 0
    """Seed of all randomness."""
    engine: Literal["mujoco", "warp", "drake"] = "mujoco"
    """Physics engine; ``warp`` needs a GPU."""
    strength: Literal["paper", "human"] | None = None
    """Strength of the athlete; by default the one the policy was trained with."""
    limits: Literal["paper", "anatomical"] | None = None
    """Joint ranges; by default those the policy was trained with."""


@dataclass(frozen=True)
class Match:
    """Let one policy play another: wins, draws, losses and Elo with 95 % intervals.

    Sides are changed in half of the games. ``--ladder A B C ...`` plays every pair and rates all,
    the first policy at 0.
    """

    policies: Positional[Annotated[tuple[str, ...], arg(metavar="A B")]]
    """Run folders, policy files, ``pretrained[:ALGO[-STRENGTH]]``, ``zero`` or ``random``; also the
    frozen opponents of a run of self-play, ``RUN@SAMPLES`` and ``RUN@rival``."""
    sport: Annotated[str, arg(name="task")] = ""
    """Sport with two sides; by default the one that the first run or file was trained on. Its
    options are ``--task.NAME``; together with this one ``--help`` lists them."""
    ladder: bool = False
    """A round robin of two or more policies."""
    out: Path | None = None
    """JSON file for the result."""
    sheet: Path | None = None
    """png, webp or jpg file for 12 frames of the best and the median of 20 games of A on side 0."""
    video: Path | None = None
    """mp4 file for the best of them."""
    renderer: Literal["gl", "software"] = "gl"
    """Of the video: ``software`` needs no library and is slower."""
    trials: int = 100
    """Games, of each pair; an even number."""
    engine: Literal["mujoco", "warp", "drake"] = "mujoco"
    """Physics engine; ``warp`` needs a GPU."""
    seed: int = 0
    """Seed of all randomness."""
    worlds: int | None = None
    """Worlds simulated at a time; by default as many as suit the engine."""
    strength: Literal["paper", "human"] | None = None
    """Strength of the athletes; by default the one the first policy was trained with."""
    limits: Literal["paper", "anatomical"] | None = None
    """Joint ranges; by default those the first policy was trained with."""


@dataclass(frozen=True)
class Leaderboard:
    """Rebuild results/README.md and the results of README.md from results/*.json."""

    results: Path = Path("results")
    """Folder of the JSON files that ``evaluate`` wrote."""
    readme: Path = Path("README.md")
    """Page whose part between the marks ``<!-- results -->`` and ``<!-- /results -->`` is set."""


@dataclass(frozen=True)
class Command:
    """A command: its options, and ``module:function`` that does it."""

    config: type | None
    """Config dataclass; None for a command that parses its own options."""
    does: str
    options: Literal["problem", "task", ""] = ""
    """Prefix of the options of the named problem or task."""
    summary: str = ""
    finds: str = ""
    """``module:function`` that tells from the arguments whose options may be set, or None; by
    default it is NAME."""

    def help(self) -> str:
        """One line for the overview."""
        return self.summary or (self.config.__doc__ or "").strip().splitlines()[0]


COMMANDS: dict[str, Command] = {
    "list": Command(List, "olympics_opt.catalogue:run_list"),
    "solve": Command(Solve, "olympics_opt.solve:run_solve", "problem"),
    "train": Command(
        None, "olympics_opt.play:run_train", summary="Train a policy, on the CPU or on GPUs."
    ),
    "lessons": Command(
        None,
        "olympics_opt.lessons:run_lessons",
        summary="Train a policy in several lessons, one after another, from one file.",
    ),
    "polish": Command(Polish, "olympics_opt.polish:run_polish", "task"),
    "export": Command(Export, "olympics_opt.play:run_export"),
    "recipe": Command(Recipe, "olympics_opt.recipe:run_recipe"),
    "evaluate": Command(Evaluate, "olympics_opt.play:run_evaluate", "task"),
    "verify": Command(Verify, "olympics_opt.verify:run_verify", "task"),
    "render": Command(Render, "olympics_opt.play:run_render", "task"),
    "play": Command(Play, "olympics_opt.viewer:run_play", "task"),
    "study": Command(Study, "olympics_opt.study:run_study"),
    "mocap": Command(
        None, "olympics_opt.mocap:main", summary="Make clips of recorded motions of people."
    ),
    "match": Command(
        Match, "olympics_opt.match:run_match", "task", finds="olympics_opt.match:find_task"
    ),
    "tracker": Command(Tracker, "olympics_opt.tracker:run_tracker"),
    "likeness": Command(Likeness, "olympics_opt.likeness:run_likeness"),
    "prior": Command(
        None, "olympics_opt.prior:main", summary="Check, play and export latent priors."
    ),
    "bench": Command(
        None, "olympics_opt.bench:main", summary="Measure physics, environment and training speed."
    ),
    "leaderboard": Command(Leaderboard, "olympics_opt.catalogue:run_leaderboard"),
}
LATER: tuple[str, ...] = ()
"""Commands of later versions: not listed, refused with a sentence."""
USER_ERRORS = (ValueError, RuntimeError, OSError, ImportError)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command line; returns the exit code."""
    args = list(sys.argv[1:] if argv is None else argv)
    # Threads that wait for each other sleep instead of spinning: on two cores with two other busy
    # programs an update of PPO took 2 s instead of 12 s. Read by OpenMP when torch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    debug = "--debug" in args
    args = [a for a in args if a != "--debug"]
    name = args[0] if args else ""
    try:
        if name in ("", "-h", "--help"):
            print(overview())
            return 0 if args else 2
        if name == "--version":
            from importlib.metadata import version

            print(f"olympics-opt {version('olympics-opt')}")
            return 0
        return run(name, args[1:])
    except SystemExit as stop:  # tyro and argparse have printed what is wrong
        if stop.code is None or isinstance(stop.code, int):
            return stop.code or 0
        print(f"olympics-opt: {stop.code}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nolympics-opt: stopped.", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader (head, a pager) has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except USER_ERRORS as error:
        if debug:
            raise
        print(f"olympics-opt {name}: {sentence(error)}".replace("  ", " "), file=sys.stderr)
        return 2


def run(name: str, args: list[str]) -> int:
    """Runs the command ``name`` with its arguments. Raises what a user's mistake raises."""
    if name not in COMMANDS:
        known = ", ".join(COMMANDS)
        if name in LATER:
            raise UsageError(f"this version has no command '{name}'; it has: {known}")
        raise UsageError(f"unknown command '{name}'; the commands are: {known}")
    command = COMMANDS[name]
    if command.config is None:
        return int(_load(command.does)(args) or 0)
    config = parse(name, command, args)
    return int(_load(command.does)(config) or 0)


def parse(name: str, command: Command, args: list[str]) -> Any:
    """The config of a command line; options of its problem or task are in its field of that name.

    Raises ValueError for an unknown problem, task or option of it; exits through tyro (code 2)
    for anything else that is wrong.
    """
    assert command.config is not None
    config_type: Any = command.config
    if command.options:
        word = command.options
        if command.finds:
            chosen = _load(command.finds)(args)
        else:
            chosen = next(iter(words_and_values(config_type, args)[0]), None)
        options = _option_type(word, chosen) if chosen is not None else None
        if options is not None:
            _check_options(word, str(chosen), options, args)
            config_type = dataclasses.make_dataclass(
                config_type.__name__,
                [(word, options, dataclasses.field(default_factory=options))],
                bases=(config_type,),
                frozen=True,
            )
            config_type.__doc__ = command.config.__doc__
    return tyro.cli(config_type, args=args, prog=f"olympics-opt {name}")


def chosen_options(config: Any, word: str) -> dict[str, Any]:
    """The options of the problem or task that differ from their defaults, by field name.

    None do where the command line did not say whose options they are.
    """
    options = getattr(config, word, None)
    if options is None:
        return {}
    default = type(options)()
    return {
        f.name: getattr(options, f.name)
        for f in dataclasses.fields(options)
        if getattr(options, f.name) != getattr(default, f.name)
    }


def overview() -> str:
    """The help text of ``olympics-opt`` itself."""
    width = max(map(len, COMMANDS)) + 2
    lines = [
        "olympics-opt COMMAND [options]",
        "",
        "Drake finds a motion, MuJoCo learns to do it a thousand ways at once, Drake checks that",
        "it is true.",
        "",
        "commands:",
        *(f"  {name:<{width}}{command.help()}" for name, command in COMMANDS.items()),
        "",
        "olympics-opt COMMAND --help lists its options; --debug shows the traceback of an error.",
    ]
    return "\n".join(lines)


def sentence(error: BaseException) -> str:
    """An exception as one sentence for the person at the keyboard."""
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        where = f" while writing {error.filename}" if error.filename else ""
        return f"the disk is full{where}; free some space and run the same command again"
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror}: {error.filename}" if error.filename else error.strerror
    if isinstance(error, ModuleNotFoundError) and error.name:
        return f"the package '{error.name}' is not installed here"
    text = re.sub(r"\s+", " ", str(error)).strip()
    return text or type(error).__name__


def words_and_values(config_type: type, args: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """What is neither an option nor its value on a command line; and the values, by option."""
    flags = {f.name for f in dataclasses.fields(config_type) if f.type in ("bool", bool)}
    flags |= {f"no_{name}" for name in flags} | {"help", "h"}
    words: list[str] = []
    values: dict[str, str] = {}
    option = ""
    for word in args:
        if option and not word.startswith("--"):
            values[option] = word
            option = ""
        elif word.startswith("-") and len(word) > 1:
            plain, equals, value = word.lstrip("-").partition("=")
            plain = plain.replace("-", "_")
            option = ""
            if equals:
                values[plain] = value
            elif plain not in flags and not _is_switch(plain):
                option = plain
        else:
            words.append(word)
    return words, values


def _load(place: str) -> Callable[..., Any]:
    module, function = place.split(":")
    return getattr(importlib.import_module(module), function)


def _is_switch(option: str) -> bool:
    """Whether a prefixed option is a switch without a value, whatever its config."""
    return ".no_" in option


def _option_type(word: str, name: str) -> type:
    """The config dataclass of a problem or task. Raises ValueError listing the known ones."""
    if word == "problem":
        from warmstart.problems import get_problem

        return get_problem(name).config
    from sports.registry import get_task

    return get_task(name).config


def _check_options(word: str, name: str, options: type, args: Sequence[str]) -> None:
    """Raises UsageError for ``--WORD.option`` that the config does not have."""
    fields = [f.name.replace("_", "-") for f in dataclasses.fields(options)]
    known = [f"--{word}.{f}" for f in fields]
    for text in args:
        if not text.startswith(f"--{word}."):
            continue
        option = text.split("=")[0].replace("_", "-")
        plain = option.replace(f"--{word}.no-", f"--{word}.")
        if option not in known and plain not in known:
            have = f"it has: {', '.join(known)}" if known else "it has none"
            raise UsageError(f"{word} '{name}' has no option {option}; {have}")
