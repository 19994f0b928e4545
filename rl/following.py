"""A learned motion tracker makes recorded motions physical: what it plays replaces them.

The paper's PHC step (Luo et al. 2023). It is the ``player`` of
:func:`warmstart.correction.correct`, which measures and judges what comes out as it does for the
search of :mod:`warmstart.tracking`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from rl.config import TRACKING
from rl.host import one_torch_thread
from rl.policy import Policy, load_policy
from rl.tracker import make_tracking_env
from rl.tracker_evaluation import tracking_config
from warmstart.clip import Clip
from warmstart.library import pack


class Follower:
    """Plays clips with a motion tracker of the file, run or name that ``load_policy`` accepts."""

    def __init__(self, source: str | Path) -> None:
        """Raises PolicyError for what is no motion tracker."""
        policy = load_policy(source, TRACKING)
        self.policy: Policy = policy
        card = policy.metadata
        self.strength = str(card.get("strength", "paper"))
        """The athlete's, with which it was trained."""
        self.limits = str(card.get("limits", "paper"))
        self._config = tracking_config(card)
        self._name = f"{card['algo']} {str(card['sha256'])[:12]}"

    def __str__(self) -> str:
        """Which one: its learner and the beginning of its file's sha256."""
        return self._name

    def __call__(self, clip: Clip, lost: float) -> Clip:
        """What the athlete does from the clip's first frame to its last, or until the links are
        further than ``lost`` (m, mean) from the clip's; at the control rate, with PD targets (the
        last frame repeats those of the one before).

        Raises ValueError for a clip of another body, RuntimeError when the simulation diverges.
        """
        last = slice(clip.num_frames - 1, None)
        # One frame more, so that the episode is not over in the last one.
        held = Clip(
            clip.fps,
            clip.body,
            np.concatenate((clip.qpos, clip.qpos[last])),
            np.concatenate((clip.qvel, clip.qvel[last])),
            ctrl=None if clip.ctrl is None else np.concatenate((clip.ctrl, clip.ctrl[last])),
        )
        env = make_tracking_env(
            pack([("clip", held)]),
            num_worlds=1,
            strength=self.strength,
            limits=self.limits,
            training=False,
            config=self._config,
            assigned=[0],
        )
        states, targets = [], []
        try:
            self.policy.check(env)
            self.policy.to(env.device)
            with one_torch_thread(env.device), torch.no_grad():
                obs = env.reset()
                for frame in range(clip.num_frames):
                    state = env.view.physics
                    states.append((state.qpos[0].clone(), state.qvel[0].clone()))
                    if frame > 0 and float(env.distance()[0]) > lost:
                        break
                    if frame == clip.num_frames - 1:
                        break
                    result = env.step(self.policy(obs))
                    if not bool(result.valid[0]):
                        raise RuntimeError(f"the simulation diverged in frame {frame + 1}")
                    assert env.view.ctrl is not None
                    targets.append(env.view.ctrl[0, 0].clone())
                    if bool(result.ended[0]):
                        break
                    obs = result.obs
        finally:
            env.close()
        qpos, qvel = (torch.stack(x).double().numpy() for x in zip(*states))
        qpos[:, :2] += clip.qpos[0, :2]  # a library's clips begin at x = y = 0
        ctrl = torch.stack([*targets, *targets[-1:]])[: len(qpos)].double().numpy()
        return Clip(clip.fps, clip.body, qpos, qvel, ctrl=ctrl, meta=dict(clip.meta))
