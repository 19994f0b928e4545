"""``olympics-opt recipe``: the commands that a policy came from."""

from __future__ import annotations

import re
import shlex
import textwrap
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from olympics_opt.cli import Recipe

WIDTH = 96


def run_recipe(config: Recipe) -> int:
    """The command. Raises ValueError for a policy that tells nothing of its training."""
    from rl.recipe import lessons_before, missing, polish_words, train_words

    card = _card(config)
    before = lessons_before(card)
    words, polished = train_words(card, init=not before), polish_words(card)
    print(_facts(card))
    run = f"runs/{config.name}"
    words += _lessons(before, card, config.name, run)
    print("\n" + wrapped([*_starter(card), config.name, "--out", run, *words]))
    told = {"averaged": _mean(card), "polish": _polish(config.name, run, card, polished)}
    for step in card:  # which has what was done to its weights in that order
        print(told.get(step, ""), end="")
    if lacking := missing(card):
        text = f"Not in the project: {', '.join(lacking)}."
        if lacking[0] == card["config"].get("init"):
            text += f" To go on from this policy itself, give --init {config.policy} instead."
        print("\n" + textwrap.fill(text, WIDTH, break_on_hyphens=False))
    if card.get("history"):
        print("\n" + textwrap.fill(str(card["history"]), WIDTH, break_on_hyphens=False))
    return 0


def _lessons(before: list[dict[str, Any]], card: dict[str, Any], task: str, run: str) -> list[str]:
    """Prints the commands of the lessons before the last; returns the last one's ``--init``."""
    start: list[str] = []
    if before:
        minutes = sum(lesson["minutes"] for lesson in card["lessons"])
        count = f"{len(card['lessons'])} lessons ({minutes:.1f} minutes)"
        print(f"\nIt learned in {count}, one after another:")
    for number, lesson in enumerate(before, 1):
        place = f"{run}_{number}_{lesson['name']}"
        told = [*_starter(card), lesson.get("task", task), "--out", place]
        told += [*shlex.split(lesson["options"]), *start]
        print("\n" + wrapped(told))
        start = ["--init", place]
    return start


def _mean(card: dict[str, Any]) -> str:
    """What became of several states, if the weights are their mean."""
    if not card.get("averaged"):
        return ""
    states = f"the mean of {len(card['averaged'])} states"
    return f"\nThe weights are {states}: train --keep-policies, export --mean.\n"


def _polish(task: str, run: str, card: dict[str, Any], words: list[str] | None) -> str:
    """The command of the last stage of a search, if there was one."""
    if words is None:
        return ""
    start = [*_polisher(card["polish"]), task, "--policy", run, "--out", f"{run}_polished"]
    episodes = f"{card['polish'].get('episodes', 0):,} episodes"
    text = f"\nThen, {episodes} in all (say how many with --minutes or --generations):\n\n"
    text += wrapped([*start, *words]) + "\n"
    if len(card["polish"].get("stages", ())) > 1:
        text += "That was its last stage of several.\n"
    return text


def _card(config: Recipe) -> dict[str, Any]:
    from rl import pretrained
    from rl.config import PRIOR
    from rl.policy import load_policy

    if config.name == PRIOR:  # no policy, but trained like one
        cards = sorted((pretrained.FOLDER / PRIOR).glob("*.safetensors"))
        if config.policy != "pretrained" or not cards:
            raise ValueError(f"of '{PRIOR}' only the shipped one has a card: leave --policy out")
        return pretrained.card(cards[0])
    return load_policy(config.policy, config.name).metadata


def _facts(card: dict[str, Any]) -> str:
    """In one line, what the last training took."""
    told = [f"{card['task']}, {card['algo']}, strength {card['strength']}"]
    if card.get("samples"):
        told.append(f"{card['samples']:,} samples")
    if card.get("minutes"):
        told.append(f"{card['minutes']:.1f} minutes")
    told += [f"{name} {card[name]}" for name in ("hardware", "commit") if card.get(name)]
    return textwrap.fill("; ".join(told), WIDTH)


def _starter(card: dict[str, Any]) -> list[str]:
    """One process, or one for each GPU that there was, at least one for each kind of worlds."""
    found = re.match(r"(\d+) x ", str(card.get("hardware", "")))
    own = card["config"].get("own_ranks", 0)
    processes = max(int(found[1]) if found else 1, own + 1)
    if processes == 1:
        return ["olympics-opt", "train"]
    return [*_among(processes), "rl.train"]


def _polisher(search: dict[str, Any]) -> list[str]:
    """As many processes as played the last stage."""
    from rl.recipe import last_worlds

    processes = last_worlds(search).get("processes", 1)
    if processes == 1:
        return ["olympics-opt", "polish"]
    return [*_among(processes), "olympics_opt", "polish"]


def _among(processes: int) -> list[str]:
    """Runs the module that follows in each of them."""
    return ["torchrun", "--standalone", "--nproc-per-node", str(processes), "-m"]


def wrapped(words: list[str]) -> str:
    """For a shell; an option stays with its values unless they fill a line."""
    from rl.recipe import by_option

    lines = [""]
    for part in by_option(words):
        for piece in [part] if len(shlex.join(part)) < WIDTH - 8 else [[word] for word in part]:
            text = shlex.join(piece)
            if lines[-1] and len(lines[-1]) + len(text) > WIDTH - 3:
                lines.append("   ")
            lines[-1] += f" {text}" if lines[-1] else text
    return " \\\n".join(lines)
