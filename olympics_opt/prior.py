"""``olympics-opt prior``: check, play and export latent priors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from olympics_opt.progress import progress

Prior = Positional[Annotated[str, arg(metavar="PRIOR")]]


@dataclass(frozen=True)
class Check:
    """Is a latent prior sound? Latents, student, and ten seconds of the prior alone.

    Exit code 1 when a check fails.
    """

    prior: Prior
    """A run of the task ``prior``, or a file."""
    clips: tuple[Path, ...]
    """A library that ``mocap pack`` wrote, or clips (.npz) and folders of them."""
    tracker: str | None = None
    """The tracker that it learned from, to compare with: a run or a policy file."""
    out: Path | None = None
    """JSON file for the result."""
    split: Literal["all", "train", "held_out"] = "all"
    """Which of the clips."""
    engine: Literal["mujoco", "warp", "drake"] = "mujoco"
    """Physics engine; ``warp`` needs a GPU."""
    worlds: int | None = None
    """Worlds simulated at a time; by default as many as suit the engine."""
    seconds: float = 10.0
    """Of playing the prior alone."""
    sampler: Literal["each", "held", "smooth", "mean"] = "each"
    """New noise every step; the same for ``hold`` steps; noise that forgets in ``hold`` steps; or
    none."""
    hold: int = 10
    """Control steps."""
    temperature: float = 1.0
    """Times the prior's standard deviation."""
    seed: int = 0
    """Of starts and latents."""


@dataclass(frozen=True)
class Play:
    """Sample a latent prior alone and look at it: a video, a sheet of pictures, or a clip."""

    prior: Prior
    """A run of the task ``prior``, or a file."""
    clips: tuple[Path, ...]
    """Clips whose frames it starts from."""
    out: Path
    """FILE.mp4 (the first world), FILE.png (a row for each world) or FILE.npz (a clip)."""
    worlds: int = 4
    """Rows of a sheet."""
    seconds: float = 10.0
    """How long."""
    sampler: Literal["each", "held", "smooth", "mean"] = "each"
    """As of ``prior check``."""
    hold: int = 10
    """Control steps."""
    temperature: float = 1.0
    """Times the prior's standard deviation."""
    seed: int = 0
    """Of starts and latents."""
    engine: Literal["mujoco", "warp", "drake"] = "mujoco"
    """Physics engine; ``warp`` needs a GPU."""
    renderer: Literal["gl", "software"] = "gl"
    """Of videos: software needs no GL library and is slower."""


@dataclass(frozen=True)
class Export:
    """Write a prior as one file and its card, with weights in fp16."""

    prior: Prior
    """A run of the task ``prior`` (its last checkpoint), or a file."""
    out: Path
    """The file, FILE.safetensors; the card is FILE.json beside it."""
    encoder: bool = True
    """Keep the encoder: ``prior check`` needs it, sports do not."""


COMMANDS = {"check": Check, "play": Play, "export": Export}


def main(args: Sequence[str]) -> int:
    """``olympics-opt prior ...``: 0 done, 1 when a check fails."""
    import tyro

    words = list(args)
    if not words or words[0] in ("-h", "--help"):
        print(
            "usage: olympics-opt prior check PRIOR --clips LIBRARY [--tracker RUN] [options]\n"
            "       olympics-opt prior play PRIOR --clips LIBRARY --out FILE.mp4|.png|.npz\n"
            "       olympics-opt prior export RUN --out FILE.safetensors\n\n"
            "check   says whether a latent prior is sound\n"
            "play    shows what it does when nothing but its own latents steers it\n"
            "export  writes it as one file with its card\n\n"
            "olympics-opt prior check --help lists the options of a command; one is made by\n"
            "olympics-opt train prior --tracker RUN --clips LIBRARY --out RUN"
        )
        return 0 if words else 2
    if words[0] not in COMMANDS:
        raise ValueError(f"prior has no command '{words[0]}'; it has: {', '.join(COMMANDS)}")
    config: Any = tyro.cli(
        COMMANDS[words[0]], args=words[1:], prog=f"olympics-opt prior {words[0]}"
    )
    return {"check": run_check, "play": run_play, "export": run_export}[words[0]](config)


def _sampler(config: Check | Play) -> Any:
    from rl.prior_play import Sampler

    return Sampler(config.sampler, config.hold, config.temperature)


def run_check(config: Check) -> int:
    """The command. Raises ValueError for what cannot be used."""
    from rl.prior import load_prior
    from rl.prior_check import check_prior
    from warmstart.atomic import prepare, write_json
    from warmstart.library import load_library

    prior, sampler = load_prior(config.prior), _sampler(config)
    library = load_library(config.clips).split(config.split)
    out = None if config.out is None else prepare(config.out)
    with progress("prior") as bar:
        result = check_prior(
            prior,
            library,
            tracker=config.tracker,
            engine=config.engine,
            num_worlds=config.worlds,
            seconds=config.seconds,
            sampler=sampler,
            seed=config.seed,
            say=bar.show,
        )
        bar.finish("sound" if result["passed"] else "not sound")
    if out is not None:
        write_json(out, result)
    for name, check in result["checks"].items():
        word = {True: "PASS", False: "FAIL", None: "not checked"}[check["passed"]]
        value = "-" if check["value"] is None else f"{check['value']:.4g}"
        print(f"{word:<12}{name:<10}{value:>8}  required: {check['required']}")
    print(f"sampler {config.sampler}, {result['worlds']} worlds, engine {config.engine}")
    if out is not None:
        print(f"wrote {out}")
    return 0 if result["passed"] else 1


def run_play(config: Play) -> int:
    """The command. Raises ValueError for what cannot be used, RuntimeError without GL."""
    from olympics_opt.clip_sheet import clip_sheet
    from olympics_opt.video import render_video
    from rl.prior import load_prior
    from rl.prior_play import play_prior
    from sports.humanoid.body import load_body
    from sports.scene import humanoid_scene
    from warmstart.atomic import prepare
    from warmstart.clip import Clip
    from warmstart.library import FPS, load_library

    suffix = config.out.suffix.lower()
    if suffix not in (".mp4", ".png", ".npz"):
        raise ValueError(f"{config.out} must end in .mp4, .png or .npz")
    prior, sampler = load_prior(config.prior), _sampler(config)
    library = load_library(config.clips)
    prepare(config.out)
    with progress("playing the prior") as bar:
        played = play_prior(
            prior,
            library,
            engine=config.engine,
            num_worlds=config.worlds,
            seconds=config.seconds,
            sampler=sampler,
            seed=config.seed,
            keep=config.worlds,
        )
        bar.finish(f"{int(played.standing.sum())} of {config.worlds} stay on their feet")
    meta = {"problem": "prior", "prior_digest": prior.digest, "seed": config.seed}
    clips = {
        f"world {w}: on its feet for {played.upright[w]:.1f} s": Clip(
            FPS, library.body, played.qpos[w], played.qvel[w], meta=meta
        )
        for w in range(config.worlds)
    }
    first = next(iter(clips.values()))
    if suffix == ".png":
        clip_sheet(clips, config.out, columns=10)
    elif suffix == ".npz":
        first.save(config.out)
    else:
        scene = humanoid_scene(load_body(library.body))
        force = [[[[0.0] * 3] * scene.body.num_links]] * len(first.qpos)
        episode: Any = SimpleNamespace(
            task="prior",
            scene=scene,
            qpos=first.qpos,
            mocap_pos=_array([]),
            ground_force=_array(force),
            metrics={},
            seed=config.seed,
            world=0,
            dt=1.0 / FPS,
        )
        render_video(episode, config.out, renderer=config.renderer, progress=True)
    print(f"wrote {config.out}")
    return 0


def _array(values: Any) -> Any:
    import numpy as np

    return np.asarray(values, dtype=float)


def run_export(config: Export) -> int:
    """The command. Raises ValueError for what cannot be used."""
    from rl.prior import load_prior, save_prior
    from warmstart.atomic import prepare

    if config.out.suffix != ".safetensors":
        raise ValueError(f"{config.out} must end in .safetensors")
    prior = load_prior(config.prior)
    path = save_prior(prior, prepare(config.out), half=True, encoder=config.encoder)
    size = path.stat().st_size / 2**20
    print(f"wrote {path} ({size:.1f} MiB) and {path.with_suffix('.json')}")
    return 0
