"""``Geometry`` for the CPU: support points by compiled loops instead of many small tensors."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from sports.physics.athletes import least_of_links, place_points
from sports.physics.base import Geometry


class CompiledGeometry(Geometry):
    """See :class:`sports.physics.base.Geometry`."""

    @cached_property
    def link_radii(self) -> Tensor:
        return self.radii

    @cached_property
    def _table(self) -> tuple[np.ndarray, np.ndarray]:
        return self.points.numpy(), self.owner.numpy()

    def link_points(self, body_pos: Tensor, rotation: Tensor, axis: int) -> Tensor:
        out = torch.empty(len(self.points), len(body_pos))
        place_points(*self._table, axis, body_pos.numpy(), rotation.numpy(), out.numpy())
        return out.T

    def least(self, values: Tensor) -> Tensor:
        out = torch.empty(self.num_links, len(values))
        least_of_links(self._table[1], values.numpy().T, out.numpy())
        return out.T
