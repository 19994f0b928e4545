"""The command lines that a policy came from, from its card.

A card holds every setting of the training that ended with the policy. What differs from today's
defaults is written as options; read again (``rl.config.parse_args``), they give the same settings.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from rl.config import PRIOR, TrainConfig, config_from_dict, task_options, with_tuples
from rl.polish_config import Polish
from warmstart.bank import data_folder

OF_THE_RUN = frozenset(
    ("task", "out", "resume", "options", "physics_options", "device", "quiet", "profile")
    + ("checkpoint_minutes", "checkpoint_iterations", "keep_policies")
)
"""Settings that change nothing in what is learned."""
ROOT = data_folder().parents[1]


def train_words(card: Mapping[str, Any], init: bool = True) -> list[str]:
    """``--option value ...``, what ``olympics-opt train TASK`` is told, but for ``--out`` and, not
    asked for, ``--init``.

    Clips that the project holds have their path in it. Raises ValueError for a card without
    settings, or with some that there are no more.
    """
    if not isinstance(card.get("config"), Mapping):
        raise ValueError("its card holds no settings of a training")
    told_then = {"out": "", **card["config"]}
    if told_then.get("task") == PRIOR:  # whose learner is no PPO
        told_then["ppo"] = {}
    config = config_from_dict(told_then)
    clips = tuple(_placed(clip) for clip in config.clips)
    config = replace(config, clips=clips, init=config.init if init else None)
    options = _options(config.task, config.options)
    plain = TrainConfig(strength=config.strength)  # which is always told
    told = ["--strength", config.strength, *_words(config, plain)]
    return [*told, *_words(options, type(options)(), "task.")]


def by_option(words: Iterable[str]) -> list[list[str]]:
    """Each option with its values; words before the first option stand together."""
    groups: list[list[str]] = []
    for word in words:
        if word.startswith("--") or not groups:
            groups.append([])
        groups[-1].append(word)
    return groups


def polish_words(card: Mapping[str, Any]) -> list[str] | None:
    """``--option value ...``, what ``olympics-opt polish TASK`` was told last, but for policies,
    ``--out`` and how long it took; None for a policy that was not polished. Raises ValueError for
    settings that there are no more."""
    search = card.get("polish")
    if search is None:
        return None
    worlds = last_worlds(search)
    task = _options(card["task"], worlds.get("task", {}))
    # "episodes" are those of the whole search.
    names = {field.name for field in fields(Polish)} - {"others", "variation", "episodes"}
    told = with_tuples({name: x for name, x in (search | worlds).items() if name in names})
    plain = Polish(name=card["task"], policy="", out=Path(), others=("",), minutes=1.0)
    try:
        spans = with_tuples(worlds.get("variation", {}))
        config = replace(plain, **told, variation=replace(plain.variation, **spans))
    except TypeError as error:
        raise ValueError(f"the settings of its polish cannot be read ({error})") from error
    return [*_words(config, plain), *_words(task, type(task)(), "task.")]


def last_worlds(search: Mapping[str, Any]) -> Mapping[str, Any]:
    """What the last episodes of a polish were played in; ``search`` is the card's word of it."""
    stages = search.get("stages") or [{"worlds": search.get("worlds", {})}]
    return stages[-1]["worlds"]


def lessons_before(card: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The lessons before the last, of which the last began with the policy that they came to."""
    return list(card.get("lessons", ()))[:-1]


def missing(card: Mapping[str, Any]) -> list[str]:
    """Files that the training began with and the project does not hold."""
    config = card.get("config") or {}
    names = [str(_placed(clip)) for clip in config.get("clips", ())]
    init = config.get("init")
    if init is not None and not str(init).startswith("pretrained") and not lessons_before(card):
        names.insert(0, str(init))
    return [name for name in names if not ((ROOT / name).exists() or Path(name).exists())]


def _placed(clip: str | Path) -> Path:
    """Where the project holds a demonstration of this name, relative to its folder; else, and where
    a folder is told, the name as it is."""
    if Path(clip).name != str(clip):
        return Path(clip)
    for found in sorted(data_folder().rglob(Path(clip).name)):
        return found.relative_to(ROOT)
    return Path(clip)


def _options(task: str, told: Mapping[str, Any]) -> Any:
    """A task's options; those that a card is too old for have their defaults."""
    try:
        return task_options(task)(**with_tuples(told))
    except TypeError as error:
        raise ValueError(f"'{task}' has other options now ({error})") from error


def _words(value: Any, usual: Any, prefix: str = "") -> Iterator[str]:
    """Options of the fields that differ from the usual ones."""
    for field in fields(value):
        told, common = getattr(value, field.name), getattr(usual, field.name)
        if told == common or (not prefix and field.name in OF_THE_RUN):
            continue
        name = field.name.replace("_", "-")
        if dataclasses.is_dataclass(told):
            yield from _words(told, common, f"{prefix}{name}.")
        elif isinstance(told, bool):
            yield f"--{prefix}{'' if told else 'no-'}{name}"
        else:
            yield f"--{prefix}{name}"
            yield from map(str, told) if isinstance(told, tuple) else [str(told)]
