"""How what a run is told changes from its beginning to its end."""

from __future__ import annotations


def annealed(first: float, last: float, share: float) -> float:
    """From first to last, geometrically, as ``share`` goes from 0 to 1."""
    return first * (last / first) ** min(max(share, 0.0), 1.0)
