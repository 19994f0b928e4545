"""Results of steps, as far as costs look at them."""

from __future__ import annotations

from types import SimpleNamespace

import torch


def ended(n: int, valid: bool = True) -> SimpleNamespace:
    """Of ``n`` worlds that go on."""
    no = torch.zeros(n, dtype=torch.bool)
    return SimpleNamespace(ended=no.clone(), valid=no | valid)
