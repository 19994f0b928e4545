"""Who plays whom in self-play, and how strong everybody is: the host's book-keeping.

Opponents are frozen policies in a number of slots, each with as many worlds as any other. An entry
without a slot of its own plays nowhere; slots that nobody needs yet repeat entries. The entries of
the ladder (the first policy, and those at fixed sample counts) stay for ever and their ratings are
fixed when they enter; of the others the weakest, by rating, makes room for a new one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from rl.elo import expected, performance

Kind = Literal["ladder", "pool", "rival"]
WINDOW = 200.0
"""Games against an entry that are remembered: older ones fade."""
MOST_GAMES = 32
"""Games of one entry and iteration that count in ratings: beyond, results of one iteration would
move a rating further than they can tell."""
FROZEN_SHARE = 0.1
"""Part of the latest policy's K with which the ratings of the pool move: a frozen policy does not
change, so its rating is the mean of more games, and the latest one's progress is not taken from
it."""


@dataclass
class Entry:
    """A frozen policy."""

    kind: Kind
    samples: int
    """Learned from when it was frozen."""
    rating: float
    results: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """Wins, draws and losses of the latest policy against it, the last ``WINDOW``."""

    @property
    def games(self) -> float:
        """Games remembered."""
        return sum(self.results)

    @property
    def lost(self) -> float:
        """Sum of the scores of the latest policy in them."""
        return self.results[0] + 0.5 * self.results[1]


class League:
    """Entries, which of them is in which slot, and ratings."""

    def __init__(self, slots: int, k_factor: float) -> None:
        """Args:
        slots: places for opponents.
        k_factor: rating points per game and unit of score.
        """
        self.k_factor = k_factor
        self.entries: list[Entry] = []
        self.slots = [-1] * slots
        """Entry in each slot."""
        self.rating = 0.0
        """Of the latest policy."""

    def enter(self, kind: Kind, samples: int) -> list[int]:
        """Adds the latest policy with its present rating; returns the slots that it takes.

        The first entry takes all. A later one takes the slot of an entry that has the most of
        them, or, where each entry has one, replaces the weakest of the pool.
        """
        self.entries.append(Entry(kind, samples, self.rating))
        new = len(self.entries) - 1
        if new == 0:
            taken = list(range(len(self.slots)))
        else:
            copies = [self.slots.count(i) for i in range(new)]
            most = max(copies)
            if most > 1:
                slot = len(self.slots) - 1 - self.slots[::-1].index(copies.index(most))
                taken = [slot]
            else:
                pool = [i for i, e in enumerate(self.entries[:new]) if e.kind == "pool"]
                weakest = min(pool, key=lambda i: (self.entries[i].rating, i))
                taken = [self.slots.index(weakest)]
                del self.entries[weakest]
                self.slots = [i - (i > weakest) for i in self.slots]
                new -= 1
        for slot in taken:
            self.slots[slot] = new
        return taken

    def record(self, counts: Sequence[Sequence[float]]) -> None:
        """Takes in (slots, 3) wins, draws and losses of the latest policy, and moves ratings.

        K times (score - expected), summed over games, up to ``MOST_GAMES`` of each entry.
        """
        moved = 0.0
        for i, entry in enumerate(self.entries):
            new = [0.0, 0.0, 0.0]
            for slot, holder in enumerate(self.slots):
                if holder == i:
                    new = [a + b for a, b in zip(new, counts[slot])]
            games = sum(new)
            if not games:
                continue
            mean = (new[0] + 0.5 * new[1]) / games
            surprise = mean - expected(self.rating - entry.rating)
            step = self.k_factor * min(games, MOST_GAMES) * surprise
            moved += step
            if entry.kind != "ladder":
                entry.rating -= FROZEN_SHARE * step
            keep = max(0.0, min(1.0, (WINDOW - games) / max(entry.games, 1.0)))
            entry.results = [keep * a + b for a, b in zip(entry.results, new)]
        self.rating += moved

    def score(self, kind: Kind) -> tuple[float | None, float]:
        """Mean score of the latest policy against the entries of a kind, each alike, and games."""
        known = [e for e in self.entries if e.kind == kind and e.games > 0]
        if not known:
            return None, 0.0
        mean = sum(e.lost / e.games for e in known) / len(known)
        return mean, sum(e.games for e in known)

    def ladder_rating(self) -> float | None:
        """Rating of the latest policy by its last games against the ladder alone."""
        met = [e for e in self.entries if e.kind == "ladder" and e.games > 0]
        if not met:
            return None
        return performance([e.lost for e in met], [e.games for e in met], [e.rating for e in met])

    def state(self) -> dict[str, Any]:
        """Everything, as plain JSON."""
        entries = [asdict(e) for e in self.entries]
        return {"entries": entries, "slots": list(self.slots), "rating": self.rating}

    def load(self, state: dict[str, Any]) -> None:
        """Takes it back. Raises ValueError for another number of slots."""
        if len(state["slots"]) != len(self.slots):
            raise ValueError(
                f"the checkpoint's pool has {len(state['slots'])} slots, this run's "
                f"{len(self.slots)}"
            )
        self.entries = [Entry(**e) for e in state["entries"]]
        self.slots, self.rating = list(state["slots"]), float(state["rating"])
