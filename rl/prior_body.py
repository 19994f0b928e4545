"""An athlete with fingers as one without: a latent prior of the one moves the other.

A prior knows the body that it learned with. Another with the same joints, which differ in length by
centimetres and carry fingers where that one has a hand, is told to it as that body in the same
posture: every link turned and turning as the athlete's, its bones its own. Where its links are and
how fast they move follows from that by forward kinematics,

    p_i = sum over the links k on the way from the root to i of R_parent(k) o_k,
    v_i = v_root + sum over the same of w_parent(k) x R_parent(k) o_k,

with the offsets ``o_k`` of the body that the prior knows. Its PD targets are angles, and mean the
same to both.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sports.frames import proprioception_slices
from sports.humanoid.body import Body, is_finger


def counterparts(known: Body, body: Body) -> list[int]:
    """For each link of the ``known`` body the link of ``body`` that turns as it does: that of the
    same name, and for a hand that ``body`` has not (its fingers hang on the wrist) its parent's.

    Raises ValueError where there is none, or where the joints of ``body`` other than of fingers are
    not all known.
    """
    found: list[int] = []
    for link in known.links:
        name = link.name
        if name not in body.link_names and name not in {x.parent for x in known.links}:
            name = str(link.parent)
        if name not in body.link_names:
            raise ValueError(f"body '{body.name}' has no link '{name}'")
        found.append(body.link_index(name))
    extra = [n for n in body.link_names if n not in known.link_names and not is_finger(n)]
    if extra:
        raise ValueError(f"body '{known.name}' has no link '{extra[0]}'")
    return found


class SeenAs:
    """What an athlete feels, as another body would, and that one's PD targets as the athlete's."""

    def __init__(self, known: Body, body: Body, device: torch.device | str) -> None:
        """Args:
        known: the body of the prior.
        body: the athlete's.
        device: where the observations live.

        Raises ValueError where ``body`` is not the other one with fingers.
        """
        links = counterparts(known, body)

        def tensor(values: object, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.as_tensor(np.asarray(values), dtype=dtype).to(device)

        self._slices = proprioception_slices(body.num_links)
        self._links = tensor(links, torch.long)
        parents = known.parents()
        above = np.eye(known.num_links)
        for i, parent in enumerate(parents):  # a parent stands before its children
            if parent >= 0:
                above[i] += above[parent]
        self._above = tensor(above)
        self._parents = tensor(np.maximum(parents, 0), torch.long)
        self._offsets = tensor([link.offset for link in known.links])
        self._lower = known.standing_height() - body.standing_height()
        """What the root is higher by on the legs of the known body (m)."""
        here = {dof.name: i for i, dof in enumerate(body.dofs)}
        there = [i for i, dof in enumerate(known.dofs) if dof.name in here]
        to = [here[known.dofs[i].name] for i in there]
        self._from, self._to = tensor(there, torch.long), tensor(to, torch.long)
        self._ratio = tensor(known.action_scale()[there] / body.action_scale()[to])
        self._dofs = body.num_dofs

    def state(self, obs: Tensor) -> Tensor:
        """(..., D) observations of the athlete -> (..., S) what the known body feels in the same
        posture (``sports.frames.proprioception``)."""
        own = self._slices
        columns = obs[..., own["body_rot"]].unflatten(-1, (-1, 2, 3))[..., self._links, :, :]
        turning = obs[..., own["body_angvel"]].unflatten(-1, (-1, 3))[..., self._links, :]
        root = obs[..., own["body_linvel"]][..., None, :3]
        first, second = columns.unbind(-2)
        third = torch.linalg.cross(first, second)
        x, y, z = self._offsets.unbind(-1)
        bones = [
            axis[..., self._parents, :] * along[:, None]
            for axis, along in ((first, x), (second, y), (third, z))
        ]
        bone = bones[0] + bones[1] + bones[2]  # (..., B, 3) from the parent's origin
        swing = torch.linalg.cross(turning[..., self._parents, :], bone)
        pos, linvel = self._above @ bone, root + self._above @ swing
        parts = (
            obs[..., own["root_height"]] + self._lower,
            pos[..., 1:, :].flatten(-2),
            columns.flatten(-3),
            linvel.flatten(-2),
            turning.flatten(-2),
        )
        return torch.cat(parts, -1)

    def targets(self, decoded: Tensor) -> Tensor:
        """(..., m) PD targets of the known body over its action scale -> (..., n) the athlete's
        over its own; 0 for fingers."""
        told = decoded.new_zeros(*decoded.shape[:-1], self._dofs)
        told[..., self._to] = decoded[..., self._from] * self._ratio
        return told
