"""``Geometry`` for the CPU: support points by compiled loops instead of many small tensors."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from sports.physics.athletes import Surface, find_lowest, find_marks
from sports.physics.base import Geometry, Marks


class CompiledGeometry(Geometry):
    """See :class:`sports.physics.base.Geometry`."""

    @cached_property
    def _surface(self) -> Surface:
        return Surface(self.points.numpy(), self.radii.numpy(), self.owner.numpy())

    def marks(self, body_pos: Tensor, rotation: Tensor, below: float) -> Marks:
        n = len(body_pos)
        standing = torch.empty(self.num_links, n, dtype=torch.bool)
        rear, ends = torch.empty(self.num_links, n), torch.empty(2, n)
        links = body_pos.numpy(), rotation.numpy()
        find_marks(
            self._surface, *links, np.float32(below), standing.numpy(), rear.numpy(), ends.numpy()
        )
        return Marks(standing.T, rear.T, *ends)

    def lowest_near(self, body_pos: Tensor, rotation: Tensor, x: float, reach: float) -> Tensor:
        out = torch.empty(len(body_pos))
        links = body_pos.numpy(), rotation.numpy()
        find_lowest(self._surface, *links, np.float32(x), np.float32(reach), out.numpy())
        return out
