"""Whether the command that a card is told as gives the settings of the card when it is read."""

from __future__ import annotations

import json
import shlex
import shutil
from dataclasses import asdict, fields, replace
from pathlib import Path

import pytest

from olympics_opt import cli
from rl import pretrained
from rl.config import config_from_dict, parse_args, task_options
from rl.recipe import OF_THE_RUN, missing, train_words

SHIPPED = [(p["task"], f"{p['name']}-{p['strength']}") for p in pretrained.available()]


def told(capsys, *args: str) -> tuple[str, list[list[str]]]:
    """What ``recipe`` prints, and the words of each command in it: a paragraph of its own, where
    a line of the policy's history may begin like one."""
    assert cli.main(["recipe", *args]) == 0
    text = capsys.readouterr().out
    parts = text.replace("\\\n", " ").split("\n\n")
    return text, [shlex.split(x) for x in parts if x.startswith(("olympics-opt ", "torchrun "))]


@pytest.mark.parametrize("task, name", SHIPPED)
def test_the_commands_of_a_shipped_policy_give_its_settings(task: str, name: str, capsys):
    card = pretrained.card(pretrained.locate(task, name))
    text, commands = told(capsys, task, "--policy", f"pretrained:{name}")
    assert max(map(len, text.splitlines())) <= 96
    before = card.get("lessons", ())[:-1]
    lessons, (train, *polish) = commands[: len(before)], commands[len(before) :]
    begin = 2 if train[0] == "olympics-opt" else train.index("rl.train") + 1
    read = parse_args(train[begin:])
    want = config_from_dict({"out": "", **card["config"]})
    if before:  # each begins with what the one before came to
        places = [words[words.index("--out") + 1] for words in lessons]
        starts = [parse_args(words[2:]).init for words in lessons]
        assert starts == [None, *places[:-1]]
        want = replace(want, init=places[-1])
    for words, lesson in zip(lessons, before, strict=True):
        alone = parse_args([lesson["task"], "--out", "x", *shlex.split(lesson["options"])])
        assert replace(parse_args(words[2:]), out=alone.out, init=None) == alone
    for field in fields(want):
        if field.name not in OF_THE_RUN | {"clips"}:
            assert getattr(read, field.name) == getattr(want, field.name), field.name
    assert [clip.name for clip in read.clips] == [Path(clip).name for clip in want.clips]
    options = task_options(task)
    both = [asdict(options(**x)) for x in (read.options, want.options)]
    assert json.dumps(both[0]) == json.dumps(both[1])  # lists and tuples are alike
    for clip in read.clips:
        assert clip.exists() == (clip.name not in text.partition("Not in the project:")[2])

    search = card.get("polish")
    assert len(polish) == (search is not None)
    if search is not None:
        words = [*polish[0][2:], "--generations", "1"]
        config = cli.parse("polish", cli.COMMANDS["polish"], words)
        worlds = (search["stages"][-1] if "stages" in search else search)["worlds"]
        for key, value in (search | worlds).items():
            if hasattr(config, key) and key not in ("episodes", "others", "task", "variation"):
                kept = getattr(config, key)
                assert (list(kept) if isinstance(kept, tuple) else kept) == value, key
        variation = worlds.get("variation", {})
        spans = {k: tuple(x) if isinstance(x, list) else x for k, x in variation.items()}
        assert config.variation == replace(type(config.variation)(), **spans)
        chosen = cli.chosen_options(config, "task")
        assert json.loads(json.dumps(chosen)) == worlds.get("task", {})


@pytest.mark.parametrize("first, then", [("averaged", "polish"), ("polish", "averaged")])
def test_a_mean_is_told_before_a_polish_or_after_it_as_it_was(first, then, tmp_path, capsys):
    shipped = pretrained.locate("long_jump", "latent")
    policy = Path(shutil.copy(shipped, tmp_path))
    card = pretrained.card(shipped)
    steps = {name: card.pop(name) for name in (first, then)}
    policy.with_suffix(".json").write_text(json.dumps(card | steps))
    text, _ = told(capsys, "long_jump", "--policy", str(policy))
    said = {"averaged": text.index("The weights are the mean of"), "polish": text.index("Then, ")}
    assert said[first] < said[then]


@pytest.mark.parametrize(
    "task, name, said",
    [
        ("hurdling", "latent-varied", ["mean of 4 states"]),
        ("long_jump", "latent", ["mean of 2 states", "13,056 episodes"]),
    ],
)
def test_two_kinds_of_worlds_want_two_processes(task, name, said, capsys):
    text, commands = told(capsys, task, "--policy", f"pretrained:{name}")
    assert commands[0][:4] == ["torchrun", "--standalone", "--nproc-per-node", "2"]
    assert all(words in text for words in said)


def test_a_polish_of_several_processes_is_told_as_one(tmp_path, capsys):
    """With a card as ``polish`` writes it under ``torchrun``."""
    shipped = pretrained.locate("long_jump", "latent")
    policy = Path(shutil.copy(shipped, tmp_path))
    card = pretrained.card(shipped)
    card["polish"]["stages"] = [{"episodes": 96, "worlds": {"engine": "mujoco", "processes": 3}}]
    policy.with_suffix(".json").write_text(json.dumps(card))
    _, (_, polish) = told(capsys, "long_jump", "--policy", str(policy))
    assert polish[:6] == "torchrun --standalone --nproc-per-node 3 -m olympics_opt".split()
    assert polish[6:8] == ["polish", "long_jump"]


def test_the_prior_has_a_recipe_too(capsys):
    text, commands = told(capsys, "prior")
    assert parse_args(commands[0][2:]).tracker == "pretrained" and "distilled" in text


def test_what_tells_nothing_of_its_training_is_refused(capsys):
    for line, said in (
        ("long_jump --policy zero", "no settings of a training"),
        ("long_jump --policy nowhere", "no policy 'nowhere'"),
        ("prior --policy zero", "leave --policy out"),
    ):
        assert cli.main(["recipe", *line.split()]) == 2
        assert said in capsys.readouterr().err
    with pytest.raises(ValueError, match="other options now"):
        train_words({"config": {**_config(), "options": {"wings": 2}}})
    with pytest.raises(ValueError, match="settings cannot be read"):
        train_words({"config": {**_config(), "wings": 2}})


def _config() -> dict:
    return pretrained.card(pretrained.locate("long_jump", "ppo"))["config"]


def test_what_a_lesson_began_with_is_no_file_that_is_missing():
    """The lesson before it made that; a clip is missing all the same."""
    card = {"config": {"init": "runs/gone", "clips": ["runs/gone.npz"]}}
    assert missing(card) == ["runs/gone", "runs/gone.npz"]
    assert missing({**card, "lessons": [{}]}) == ["runs/gone", "runs/gone.npz"]
    assert missing({**card, "lessons": [{}, {}]}) == ["runs/gone.npz"]
