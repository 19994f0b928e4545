"""Processes of one training that play in the task's own worlds, beside others that do not."""

import pytest
import torch

from rl.assembly import default_env, of_rank, plays_own
from rl.config import TrainConfig
from rl.meter import apart
from rl.train import main
from rl.worlds import DRAKE
from sports.env import make_env, make_scene

CONFIG = TrainConfig(
    task="long_jump", worlds=3, like_drake=True, timestep_divisor=2, own_ranks=1, seed=4
)


def played(env, steps: int = 12) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    env.reset()
    shape = (steps, env.num_worlds, env.num_agents, env.action_size)
    actions = 0.3 * torch.randn(shape, generator=generator)
    seen = torch.stack([env.step(a).obs for a in actions])
    env.close()
    return seen


def test_the_last_rank_plays_the_task_as_it_is():
    plain = played(make_env("long_jump", num_worlds=3, seed=9, training=True))
    own = played(default_env(of_rank(CONFIG, 2, 3), seed=9))
    torch.testing.assert_close(own, plain, atol=0, rtol=0)
    for rank in (0, 1):
        assert of_rank(CONFIG, rank, 3) is CONFIG
    other = default_env(CONFIG, seed=9)
    assert other.physics.scene.timestep == make_scene("long_jump").timestep / 2
    assert not torch.equal(played(other), plain)
    assert DRAKE.own_share == 0.0, "the others have none of their own"


def test_sums_of_the_two_kinds_stay_apart():
    """Each of three ranks adds a power of ten; the last one is own."""
    sums = sum(
        apart(torch.tensor([10.0**rank, 1.0]), plays_own(CONFIG, rank, 3)) for rank in range(3)
    )
    assert isinstance(sums, torch.Tensor) and sums.tolist() == [11.0, 2.0, 100.0, 1.0]


def test_mistakes_are_sentences(capsys, tmp_path):
    with pytest.raises(ValueError, match="leaves none of 1 processes"):
        of_rank(CONFIG, 0, 1)
    out = ["--out", str(tmp_path / "run")]
    assert main(["long_jump", "--vary", "--own-ranks", "1", *out]) == 2
    assert "start more with torchrun" in capsys.readouterr().err
    assert main(["long_jump", "--own-ranks", "1", *out]) == 2
    assert "leave --own-ranks out" in capsys.readouterr().err
    assert main(["long_jump", "--vary", "--own-ranks", "-1", *out]) == 2
    assert "must not be negative" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
