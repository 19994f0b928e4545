"""A step on the device, recorded once as a CUDA graph and replayed."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch
from torch import Tensor


class GraphedStep:
    """Calls ``step(rows)``; after a few plain calls it records the step and replays it.

    The step must read and write tensors at fixed addresses and never wait for the device. Where
    recording fails (or is not wanted), plain calls go on and a warning says why.
    """

    def __init__(
        self, step: Callable[[Tensor], None], before_capture: Callable[[], None], wanted: bool
    ) -> None:
        self._step, self._before_capture = step, before_capture
        self._plain_calls = 4 if wanted else -1
        self._rows = torch.zeros(0)
        self.graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, rows: Tensor) -> None:
        """Runs the step on ``rows`` (m,), always of the same size."""
        if self._plain_calls == 0:
            self._capture(rows)
        if self._plain_calls > 0:
            self._plain_calls -= 1
        if self.graph is None:
            self._step(rows)
        else:
            self._rows.copy_(rows)
            self.graph.replay()

    def _capture(self, rows: Tensor) -> None:
        self._plain_calls = -1
        self._rows = rows.clone()
        graph = torch.cuda.CUDAGraph()
        try:
            torch.cuda.synchronize()
            self._before_capture()
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                self._step(self._rows)
            self.graph = graph
        except RuntimeError as error:
            torch.cuda.synchronize()
            self._before_capture()
            warnings.warn(f"the update runs without a CUDA graph: {error}", stacklevel=3)
