"""What a run of training is told: its settings, what they rule out, and their command line."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from rl.amp import AMPConfig
from rl.cloning import RATES
from rl.latent_action import LatentConfig
from rl.ppo import PAPER, PPOConfig
from rl.selfplay import SelfPlayConfig
from rl.steady import BALANCE
from rl.until import Until
from rl.worlds import are_own
from rl.worlds import mistakes as world_mistakes
from sports.env import Starts
from sports.physics.variation import Variation
from sports.registry import get_task, task_names
from sports.retries import Retries

DEFAULT_WORLDS = {"mujoco": 256, "warp": 8192, "drake": 4}
DEFAULT_SAMPLES = 100_000_000
TRACKING = "tracking"
"""The task of the motion tracker. It is not in the registry: it is nothing without clips."""
PRIOR = "prior"
"""The distillation of the tracker into a latent prior: not a sport either."""
LEAST_SIGMA = 0.05
"""Noise of actions below which bfloat16 is too coarse."""
APART = (TRACKING, PRIOR, BALANCE)
"""Tasks beside the registry: those that need clips."""


@dataclass(frozen=True)
class TrainConfig:
    """What to train, on what, for how long."""

    task: tyro.conf.Suppress[str] = ""
    """Name of the task."""
    out: Path = Path("runs/train")
    """Folder of the run."""
    algo: Literal["ppo", "amp", "selfplay", "latent", "latent-amp", "latent-selfplay"] = "ppo"
    """Learner: ppo; amp, which also pays for moving like the ``clips``; or selfplay, ppo against
    itself and its past, for tasks with two sides. With ``--prior`` they are latent, latent-amp and
    latent-selfplay."""
    engine: Literal["mujoco", "warp", "drake"] = "mujoco"
    """Physics engine: mujoco needs no GPU, warp needs one, drake is for checking, not training."""
    worlds: int | None = None
    """Worlds per process, which with torchrun is per GPU; None for 256 on mujoco and 8192 on
    warp."""
    samples: int | None = None
    """Stop after this many samples, of all processes together; None for 100 M where no minutes are
    given."""
    minutes: float | None = None
    """Stop after this many minutes of training, earlier sessions of the run counted in."""
    until: str | None = None
    """Stop as soon as a figure of progress.csv, as the mean of its last 12 values, has come to a
    level: ``"metrics/success>=0.9"``, ``"curriculum/h_max>=0.55"``; ``samples`` and ``minutes``
    bound it all the same, and schedules go by them."""
    seed: int = 0
    """Seed of weights, noise and environment."""
    resume: bool = False
    """Go on from the run's last checkpoint, with the run's own settings; a folder without one
    begins afresh."""
    strength: Literal["paper", "human"] = "paper"
    """Torque limits of the athlete."""
    limits: Literal["paper", "anatomical"] = "paper"
    """Joint limits of the athlete."""
    options: tyro.conf.Suppress[dict[str, Any]] = field(default_factory=dict)
    """The task's own options by name; on the command line ``--task.NAME``."""
    physics_options: tyro.conf.Suppress[dict[str, Any]] = field(default_factory=dict)
    """Options of the engine."""
    timestep_divisor: int = 1
    """2 halves the physics time step at the same control rate."""
    vary: bool = False
    """Let the worlds differ in friction, gains and contact softness and, with a
    ``timestep_divisor`` of 2 or 4, in time step: half of them take longer ones, up to the full
    step. In half of them contacts feel the joints' damping. A policy that must hold in every engine
    needs it."""
    variation: Variation = field(default_factory=Variation)
    """How, with ``--vary``: ranges and shares of worlds."""
    like_drake: bool = False
    """Let the worlds differ so that what is learned holds in Drake: feet stick instead of creeping,
    and contacts feel the joints' damping in four worlds of five (``rl.worlds.DRAKE``;
    docs/physics.md, "Feet that creep"). Short for ``--vary`` with four of its options; a
    ``timestep_divisor`` of 2 brings finer steps in."""
    felt_damping: bool = False
    """Contacts feel the joints' damping in all worlds, as in Drake (docs/physics.md). The policy is
    then one for Drake, and may fail in evaluations on mujoco without it."""
    own_ranks: int = 0
    """With torchrun, so many processes play in the task's own worlds at its own time step, whatever
    the options above say of the others: on a GPU friction has one cone for all worlds of a process,
    and a runner who knows the one may fall in the other (docs/physics.md, "A pyramid or a
    cone")."""
    init: str | None = None
    """Start from this policy: a run, a policy file, or pretrained[:ALGO[-STRENGTH]]; also that of
    another task with the same body (tennis for tennis_1v1). The statistics of what it observes stay
    as they are (``--ppo.moving-statistics``)."""
    clips: tuple[Path, ...] = ()
    """Demonstrations (npz): their frames may start episodes, and amp learns their style; for the
    task ``tracking`` the motions to follow: a packed library, or clips and folders of them."""
    tracker: str | None = None
    """For the task ``prior``: the motion tracker to learn from, a run or a policy file."""
    prior: str | None = None
    """Act through this latent prior: a run of the task ``prior`` or ``balance``, a file, or
    pretrained."""
    latent: LatentConfig = field(default_factory=LatentConfig)
    """How, with ``--prior``."""
    start_probability: tuple[float, float] = (0.5, 0.1)
    """Share of episodes that start from a demonstration, at the beginning and end of the run."""
    retries: Retries = field(default_factory=Retries)
    """Episodes that begin shortly before an earlier one failed."""
    imitation: float = 0.0
    """Reward per step for moving exactly like the demonstrations; fades to 0 over
    ``imitation_share`` of the run."""
    imitation_share: float = 0.5
    """Part of the run in which the imitation reward lasts."""
    imitation_sharpness: float = 10.0
    """The imitation reward falls with exp(-this x squared joint difference in rad^2)."""
    clone: int = 0
    """Iterations at the beginning in which the actor learns the targets of the one clip in
    ``clips``, a whole episode of the task (``rl/cloning.py``)."""
    clone_rates: tuple[float, float] = RATES
    """Learning rates at the beginning and the end of the cloning; with ``--init`` of an actor that
    was cloned before, begin lower."""
    clone_fingers: bool = False
    """The fingers go on learning the clip's targets for the whole run."""
    impact: float = 0.0
    """Cost per step of each body weight by which the ground's force on a link exceeds
    ``impact_limit``: keeps motion off the hard impacts in which engines differ."""
    impact_limit: float = 5.0
    """Body weights of ground force on a link that cost nothing."""
    sinking: float = 0.0
    """Cost per step of each centimetre that the athlete's lowest point is deeper in the ground than
    ``sinking_limit``: what a cost of impacts does not see of landings that no ground bears."""
    sinking_limit: float = 0.02
    """Depth (m) that costs nothing; people sink in by 2.4 cm at most."""
    sinking_most: float = 0.1
    """Depth (m) beyond ``sinking_limit`` from which on no more costs more: with 0.01 each frame
    that is too deep counts, and a few landings do not take the most of the cost."""
    torque_change: float = 0.0
    """Cost per step of the squared change of each joint's torque since the step before, in shares
    of its limit, as far as it exceeds ``torque_change_limit``, summed: for motion without
    flutter."""
    torque_change_limit: float = 0.0
    """Change of a torque from step to step, in shares of the joint's limit, that costs nothing. A
    person's changes by about 0.67 at most; in fast motion of many joints nearly all of the cost is
    of changes below that, unless they are free."""
    charge_limit: float | None = None
    """These costs together take at most this share of what the task pays on average, by one factor
    for all; without it as much as they come to, and where that is more than the pay an athlete
    learns to fall over at once."""
    paper: bool = False
    """Use the hyper-parameters of the SMPLOlympics paper instead of ``ppo``."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Hyper-parameters."""
    amp: AMPConfig = field(default_factory=AMPConfig)
    """Hyper-parameters of the style, for ``--algo amp``."""
    selfplay: SelfPlayConfig = field(default_factory=SelfPlayConfig)
    """Opponents, for ``--algo selfplay``."""
    device: str = "auto"
    """Where the networks live: auto (a GPU if there is one), cpu, cuda."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Of the matrix products: auto is bfloat16 on a GPU while ``--ppo.sigma`` stays at
    ``LEAST_SIGMA`` or above, else float32. On a CPU bfloat16 is about twice as fast if the
    processor has instructions for it, and slower if not. It knows an action of 0.5 to 0.002, and
    differs that much between the rows of a rollout and those of a minibatch: at a sigma of 0.02
    that alone is a divergence of 0.015, which drives the learning rate to its least."""
    checkpoint_minutes: float = 2.0
    """A checkpoint at least this often."""
    checkpoint_iterations: int | None = None
    """And after every so many iterations."""
    keep_policies: bool = False
    """Keep the policy of every checkpoint, with its critic, as RUN/policies/SAMPLES.safetensors: an
    earlier one may be the best in another engine, and the mean of several (``export --mean``) is
    often better than each."""
    cuda_graph: bool = True
    """Replay the update as a CUDA graph where that is possible."""
    quiet: bool = False
    """Print nothing."""
    profile: bool = False
    """Measure a few updates instead of training: a table of where their time goes, and
    ``trace.json.gz`` in the run's folder for chrome://tracing or ui.perfetto.dev."""

    def __post_init__(self) -> None:
        for mistake in _mistakes(self):
            raise ValueError(mistake)

    @property
    def hyper(self) -> PPOConfig:
        """The hyper-parameters in force."""
        ppo = PAPER if self.paper else self.ppo
        # The noise of ``balance`` is the prior's own.
        return replace(ppo, sigma=1.0, sigma_final=None) if self.task == BALANCE else ppo

    @property
    def bf16(self) -> bool | None:
        """Whether learners multiply in bfloat16; None for on a GPU only."""
        if self.precision != "auto":
            return self.precision == "bfloat16"
        hyper = self.hyper
        least = hyper.sigma if hyper.sigma_final is None else min(hyper.sigma, hyper.sigma_final)
        return None if least >= LEAST_SIGMA else False

    @property
    def styled(self) -> bool:
        """Whether moving like the clips is paid for."""
        return self.algo in ("amp", "latent-amp")

    @property
    def contested(self) -> bool:
        """Whether the learner plays against itself and its past."""
        return self.algo in ("selfplay", "latent-selfplay")

    @property
    def method(self) -> str:
        """The learner's full name, for cards."""
        if self.prior is None:
            return self.algo
        return "latent-amp" if self.styled else "latent-selfplay" if self.contested else "latent"

    @property
    def num_worlds(self) -> int:
        """Worlds per process."""
        return self.worlds or DEFAULT_WORLDS[self.engine]


def _mistakes(c: TrainConfig) -> Iterator[str]:
    """What cannot be, setting by setting and then where two contradict each other."""
    for name in ("worlds", "samples", "minutes", "checkpoint_iterations"):
        value = getattr(c, name)
        if value is not None and value <= 0:
            yield f"{name} must be positive, not {value}"
    if c.until is not None:
        try:
            Until(c.until)
        except ValueError as error:
            yield str(error)
    if c.impact < 0.0 or c.impact_limit < 0.0:
        yield "impact and impact_limit must not be negative"
    if c.sinking < 0.0 or c.sinking_limit < 0.0:
        yield "sinking and sinking_limit must not be negative"
    if c.sinking_most <= 0.0:
        yield f"sinking_most must be positive: {c.sinking_most}"
    if c.torque_change < 0.0 or c.torque_change_limit < 0.0:
        yield "torque_change and torque_change_limit must not be negative"
    if c.torque_change_limit and not c.torque_change:
        yield "--torque-change-limit is of what is charged: give --torque-change"
    if c.charge_limit is not None:
        if not 0.0 < c.charge_limit < 1.0:
            yield f"charge_limit must lie between 0 and 1: {c.charge_limit}"
        if not (c.impact or c.sinking or c.torque_change):
            yield "--charge-limit limits charges: give --impact, --sinking or --torque-change"
    if not all(0.0 <= p <= 1.0 for p in c.start_probability):
        yield f"start_probability must lie in [0, 1], not {c.start_probability}"
    yield from world_mistakes(c)
    if c.own_ranks < 0:
        yield f"own-ranks must not be negative: {c.own_ranks}"
    if c.own_ranks and are_own(c):
        yield "all processes play in the task's own worlds: leave --own-ranks out, or give --vary"
    if c.hyper.anchor and c.init is None:
        yield "--ppo.anchor holds an actor to the policy that it began as: give --init"
    if c.retries.share and (c.contested or c.clone or c.task in APART):
        yield "retries are for one athlete who learns a sport: leave --retries.share out"
    if c.clone < 0:
        yield f"clone must not be negative: {c.clone}"

    if not 0.0 < min(c.clone_rates):
        yield f"clone-rates must be above 0, not {c.clone_rates}"
    if c.clone_fingers and not c.clone:
        yield "--clone-fingers is for a run that clones: give --clone as well"
    if c.clone and len(c.clips) != 1:
        yield "cloning needs one clip of a whole episode: give it with --clips"
    if c.clone and (c.prior is not None or c.task == PRIOR):
        yield "the targets of a clip are no latents: leave --clone or --prior out"

    if not c.styled and c.amp != AMPConfig():
        yield "the --amp options need --algo amp"
    if not c.contested and c.selfplay != SelfPlayConfig():
        yield "the --selfplay options need --algo selfplay"
    if c.contested and c.clone:
        yield "cloning shows one athlete's episode: leave --algo selfplay out"
    if c.styled and c.task == TRACKING:
        yield "the tracker follows its clips frame by frame: leave --algo amp out"

    if c.task == BALANCE:
        if c.prior is None:
            yield "balance is learned by a latent prior: give --prior"
        if c.algo != "ppo" or c.clone or c.latent != LatentConfig():
            yield "balance is ppo on the prior as it plays: leave --algo, --clone, --latent out"
        if (c.ppo.sigma, c.ppo.sigma_final) not in ((PPOConfig.sigma, None), (1.0, None)):
            yield "the noise of balance is the prior's own: leave --ppo.sigma out"
    if c.prior is None and (c.algo.startswith("latent") or c.latent != LatentConfig()):
        yield "--algo latent and the --latent options need --prior"
    if c.prior is not None and c.task in (TRACKING, PRIOR):
        yield f"the task '{c.task}' comes before a latent prior: leave it out"
    if c.task not in ("", PRIOR) and c.tracker is not None:
        yield "--tracker is for the task 'prior' alone"
    if c.keep_policies and c.task in (PRIOR, BALANCE):
        yield f"'{c.task}' makes a latent prior, not policies: leave --keep-policies out"
    if c.task == PRIOR and (c.algo != "ppo" or c.ppo != PPOConfig() or c.paper):
        yield "the task 'prior' has a learner of its own: its options are --task.*"

    if c.paper and c.ppo != PPOConfig():
        yield "--paper fixes the hyper-parameters: leave the --ppo options out"


def task_options(task: str) -> type:
    """The options' dataclass of a task. Raises ValueError for an unknown one."""
    if task == PRIOR:
        from rl.latent_config import PriorConfig

        return PriorConfig
    if task == TRACKING:
        from rl.tracker import TrackingConfig

        return TrackingConfig
    if task == BALANCE:
        from rl.balance import BalanceConfig

        return BalanceConfig
    return get_task(task).config


def usual_options(task: str) -> dict[str, Any]:
    """A task's options at their defaults, as JSON has them; none where it is not known."""
    if task not in (*task_names(), *APART):
        return {}
    return json.loads(json.dumps(dataclasses.asdict(task_options(task)()), default=str))


def load_starts(paths: tuple[Path, ...], probability: float) -> Starts:
    """Demonstration frames from clip files. Raises ValueError for a file that is not a clip."""
    from warmstart.bank import ClipBank
    from warmstart.clip import Clip

    return ClipBank([Clip.load(path) for path in paths]).starts(probability=probability)


def load_placed_starts(paths: tuple[Path, ...], probability: float) -> Starts | None:
    """Starts from those of the clips that an optimisation put into the task's world, or None.

    A captured motion shows a style wherever it was recorded; an episode cannot start there.
    Raises ValueError for a file that is not a clip.
    """
    from warmstart.clip import Clip

    placed = tuple(p for p in paths if "problem" in Clip.load(p).meta)
    return load_starts(placed, probability) if placed else None


def with_tuples(data: Mapping[str, Any]) -> dict[str, Any]:
    """Settings from JSON, which has no tuples: its lists were some."""
    return {name: tuple(x) if isinstance(x, list) else x for name, x in data.items()}


def config_from_dict(data: dict[str, Any]) -> TrainConfig:
    """A TrainConfig from its JSON. Raises ValueError where it is not one."""
    try:
        data = dict(data)
        ppo = dict(data.pop("ppo"))
        for name in ("hidden", "kl_band", "kl_band_final", "learning_rate_limits"):
            if ppo.get(name) is not None:  # runs of older versions lack the newer ones
                ppo[name] = tuple(ppo[name])
        amp = dict(data.pop("amp", {}))  # none in runs of versions without it
        amp |= {"hidden": tuple(amp["hidden"])} if "hidden" in amp else {}
        rivals = dict(data.pop("selfplay", {}))
        rivals |= {"ladder": tuple(rivals["ladder"])} if "ladder" in rivals else {}
        data["out"] = Path(data["out"])
        data["clips"] = tuple(Path(p) for p in data["clips"])
        data["start_probability"] = tuple(data["start_probability"])
        if "clone_rates" in data:  # none in runs of versions without it
            data["clone_rates"] = tuple(data["clone_rates"])
        latent = LatentConfig(**data.pop("latent", {}))
        spans = with_tuples(data.pop("variation", {}))
        how = {"ppo": PPOConfig(**ppo), "amp": AMPConfig(**amp), "latent": latent}
        how["retries"] = Retries(**with_tuples(data.pop("retries", {})))
        vary = Variation(**spans)
        return TrainConfig(**data, **how, variation=vary, selfplay=SelfPlayConfig(**rivals))
    except (TypeError, KeyError) as error:
        raise ValueError(f"the run's settings cannot be read ({error})") from error


def parse_args(args: list[str], prog: str = "python -m rl.train") -> TrainConfig:
    """``TASK [options]`` -> TrainConfig; the task's options are ``--task.NAME``.

    Raises ValueError for an unknown task; exits with code 2 and a message for other mistakes.
    """
    known = ", ".join((*task_names(), *APART))
    if not args or args[0].startswith("-"):
        if not {"-h", "--help"} & set(args):
            raise ValueError(f"say which task to train: {known}")
        print(f"usage: {prog} TASK [options], TASK one of {known}\n")
        tyro.cli(TrainConfig, args=args, prog=f"{prog} TASK")
    name, options_type = args[0], task_options(args[0])

    def command(run: TrainConfig, task: Any) -> TrainConfig:
        given = {f.name: getattr(task, f.name) for f in dataclasses.fields(task)}
        return replace(run, task=name, options=given)

    command.__annotations__ = {
        "run": Annotated[TrainConfig, tyro.conf.arg(name="")],
        "task": options_type,
    }
    return tyro.cli(command, args=args[1:], prog=f"{prog} {name}")
