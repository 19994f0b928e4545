"""Episode statistics of a rollout, kept on the environment's device until someone asks."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

_HEAD = ("steps", "invalid", "episodes", "return", "episode_steps")


def apart(totals: Tensor, second: bool) -> Tensor:
    """(2 K,) ``totals`` (K,) as the first half or the second, and zeros: when ranks add theirs up,
    those of two kinds stay apart."""
    none = torch.zeros_like(totals)
    return torch.cat((none, totals) if second else (totals, none))


class EpisodeMeter:
    """Adds up what every step reports: rewards by term, and each ended episode's metrics.

    Call it with each StepResult. ``totals`` hands the sums over and starts anew; running
    episodes go on.
    """

    def __init__(self, env: Any) -> None:
        self._metrics = tuple(env.metric_names)
        self._terms: tuple[str, ...] = ()
        self._return = torch.zeros(env.num_worlds, env.num_agents, device=env.device)
        self._length = torch.zeros(env.num_worlds, device=env.device)
        self._sums = torch.zeros(0, dtype=torch.float64, device=env.device)

    def __call__(self, result: Any) -> None:
        """Takes one step in."""
        self._terms = self._terms or tuple(result.terms)
        valid = result.valid
        ended = result.ended
        self._return += torch.where(valid[:, None], result.reward, 0.0)
        self._length += 1.0
        sums = [
            valid.sum(),
            (~valid).sum(),
            ended.sum(),
            (self._return.mean(-1) * ended).sum(),
            (self._length * ended).sum(),
        ]
        for name in self._metrics:
            value = result.metrics[name]
            counted = ended & ~torch.isnan(value)
            sums += [torch.where(counted, value, 0.0).sum(), counted.sum()]
        sums += [result.terms[name].mean(-1).sum() for name in self._terms]
        step = torch.stack([x.double() for x in sums])
        self._sums = self._sums + step if self._sums.numel() else step
        fresh = ended | ~valid
        self._return = torch.where(fresh[:, None], 0.0, self._return)
        self._length = torch.where(fresh, 0.0, self._length)

    def totals(self) -> Tensor:
        """(K,) float64 sums since the last call; ranks may add theirs."""
        sums, self._sums = self._sums, self._sums[:0]
        return sums

    def summary(self, totals: list[float]) -> dict[str, float | int | None]:
        """Means from ``totals``; None where nothing ended or a metric was never defined."""
        steps, invalid, episodes, returns, lengths = totals[: len(_HEAD)]
        out: dict[str, float | int | None] = {
            "episodes": int(episodes),
            "invalid": int(invalid),
            "return": returns / episodes if episodes else None,
            "episode_steps": lengths / episodes if episodes else None,
        }
        at = len(_HEAD)
        for name in self._metrics:
            out[f"metrics/{name}"] = totals[at] / totals[at + 1] if totals[at + 1] else None
            at += 2
        for k, name in enumerate(self._terms):
            out[f"terms/{name}"] = totals[at + k] / max(steps, 1.0)
        return out

    def metrics(self, totals: list[float], kind: str) -> dict[str, float | int | None]:
        """Those of ``summary`` that are metrics, as columns of a kind of ranks."""
        found = self.summary(totals)
        return {f"{kind}/{name}": found[f"metrics/{name}"] for name in self._metrics}

    def state_dict(self) -> dict[str, Tensor]:
        """Running episodes' returns and lengths."""
        return {"return": self._return, "length": self._length}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Takes them back."""
        self._return = state["return"].to(self._return)
        self._length = state["length"].to(self._length)
