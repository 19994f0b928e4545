"""What motions are compared with: people that no training saw, as figures and window features.

A reference is made of the held-out clips of a library. One made of openly licensed archives is
shipped (``likeness_reference.npz`` and its card), so that the panel works without clips: of each
clip three figures, and of each second 32 numbers, from which no motion can be made again.

    python -m rl.likeness_reference --clips LIBRARY --out FILE.npz

writes such a file. Archives for non-commercial use and optimised demonstrations are left out.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rl.likeness_features import NAME, SIZE, window_features
from rl.likeness_motion import Motion, captured, from_library, short_name
from rl.likeness_terms import UNITS, figures
from rl.two_sample import classifier_accuracy, frechet
from warmstart.atomic import write_json
from warmstart.library import Library
from warmstart.npz import read_npz, write_npz

FORMAT = "olympics-opt likeness reference 1"
SHIPPED = Path(__file__).with_suffix(".npz")
FIGURES = tuple(UNITS)[:3]
"""Figures that a captured motion has."""
BAND = (0.05, 0.95)
"""Quantiles of the reference's clips between which a figure counts as human."""
PAD, GROUND = 0.01, 0.025
"""m that a motion may sink in: of a captured one as much as a sole yields (the pad of the heel
gives 9 mm in running, De Clercq et al. 1994, J Biomech 27:1213), since clips were lifted out of the
ground when they were made; of a simulated one as much as its ground yields to people: the shipped
demonstrations sink in by up to 2.4 cm, whose effort and speed are a person's."""
DIVISIONS = 10
"""Ways to divide the reference in two by archive, the most even ones, and as many by clip."""
FEWEST = 8
"""Windows below which a set has no distribution to speak of."""


@dataclass(frozen=True, eq=False)
class Reference:
    """Figures and window features of C clips with W windows."""

    names: tuple[str, ...]
    groups: tuple[str, ...]
    """(C,) archive of each clip."""
    licences: tuple[str, ...]
    counts: np.ndarray
    """(C,) windows of each clip, in the order of ``features``."""
    features: np.ndarray
    """(W, D)"""
    table: np.ndarray
    """(C, 3) ``FIGURES`` of each clip, NaN where it does not tell."""
    seconds: float
    origin: str
    """sha256 of the library's motions."""
    known_floors: dict[str, Any] | None = None
    """Floors that were worked out when the file was made."""

    @cached_property
    def clip_of(self) -> np.ndarray:
        """(W,) index of the clip of each window."""
        return np.repeat(np.arange(len(self.names)), self.counts)

    def window_names(self) -> list[str]:
        """(W,) name of the clip of each window."""
        return [self.names[i] for i in self.clip_of]

    def without(self, names: Iterable[str], archives: Iterable[str] = ()) -> Reference:
        """The clips but those whose names without folders are among ``names``, and without some
        archives.

        Raises ValueError if too few windows are left to compare with.
        """
        names, archives = set(names), set(archives)
        keep = [
            i
            for i, (name, group) in enumerate(zip(self.names, self.groups))
            if short_name(name) not in names and group not in archives
        ]
        if len(keep) == len(self.names):
            return self
        rest = self._chosen(keep)
        if len(rest.features) < 2 * FEWEST:
            raise ValueError(
                "training or the motions themselves used nearly all clips of the reference: give "
                "--clips with others that are held out"
            )
        return rest

    def _chosen(self, clips: Sequence[int]) -> Reference:
        rows = np.isin(self.clip_of, clips)
        return replace(
            self,
            names=tuple(self.names[i] for i in clips),
            groups=tuple(self.groups[i] for i in clips),
            licences=tuple(self.licences[i] for i in clips),
            counts=self.counts[list(clips)],
            features=self.features[rows],
            table=self.table[list(clips)],
            known_floors=None,
        )

    def band(self, figure: str, simulated: bool = False) -> dict[str, Any]:
        """{"low", "high", "n"}: quantiles of the clips, see ``BAND``; None without clips.

        For ``penetration`` ``high`` is at least what sole or ground yield, see ``PAD``.
        """
        values = self.table[:, FIGURES.index(figure)]
        values = values[~np.isnan(values)]
        if not len(values):
            return {"low": None, "high": None, "n": 0}
        low, high = (float(np.quantile(values, q)) for q in BAND)
        if figure == "penetration":
            high = max(high, GROUND if simulated else PAD)
        return {"low": low, "high": high, "n": len(values)}

    @cached_property
    def floors(self) -> dict[str, dict[str, Any]]:
        """What people come to among themselves: {"frechet", "classifier": {"archives", "halves",
        "clips", "high"}}.

        ``archives``: each archive against all others; ``halves``: divisions by archive;
        ``clips``: divisions by clip, in which both halves have the same archives. Lists of values.
        ``high`` is the upper quantile of ``BAND`` of the first two together (of the third without a
        second archive): what people differ by who were recorded elsewhere and do something else.
        """
        if self.known_floors is not None:
            return self.known_floors
        kinds = {
            "archives": self._single_archives(),
            "halves": self._halves_by_archive(),
            "clips": self._halves_by_clip(),
        }
        out: dict[str, dict[str, Any]] = {"frechet": {}, "classifier": {}}
        for kind, sides in kinds.items():
            compared = [self._compare(side) for side in sides]
            out["frechet"][kind] = [round(f, 4) for f, _ in compared]
            out["classifier"][kind] = [round(c, 4) for _, c in compared if not np.isnan(c)]
        for row in out.values():
            strict = row["archives"] + row["halves"] or row["clips"]
            row["high"] = round(float(np.quantile(strict, BAND[1])), 4) if strict else None
        return out

    def _compare(self, side: np.ndarray) -> tuple[float, float]:
        """Distance and accuracy between the clips (C,) where ``side`` and the others."""
        rows = side[self.clip_of]
        a, b = self.features[rows], self.features[~rows]
        mine, others = (
            [n for n, inside in zip(self.window_names(), rows) if inside == wanted]
            for wanted in (True, False)
        )
        return frechet(a, b), classifier_accuracy(a, mine, b, others)

    def _windows(self, side: np.ndarray) -> int:
        """Windows of the smaller part."""
        mine = int(self.counts[side].sum())
        return min(mine, int(self.counts.sum()) - mine)

    def _single_archives(self) -> list[np.ndarray]:
        groups = np.asarray(self.groups)
        sides = [groups == name for name in sorted(set(self.groups))]
        return [s for s in sides if self._windows(s) >= FEWEST]

    def _halves_by_archive(self) -> list[np.ndarray]:
        names, of = sorted(set(self.groups)), np.asarray(self.groups)
        sides = []
        for size in range(1, len(names) // 2 + 1):
            for some in itertools.combinations(names, size):
                if 2 * size < len(names) or some[0] == names[0]:
                    sides.append(np.isin(of, some))
        sides = [s for s in sides if self._windows(s) >= max(FEWEST, 0.2 * len(self.features))]
        return sorted(sides, key=lambda s: -self._windows(s))[:DIVISIONS]

    def _halves_by_clip(self) -> list[np.ndarray]:
        """By bits of the hashes of the names, the same on every machine."""
        hashes = [hashlib.sha256(name.encode()).digest() for name in self.names]
        sides = [np.array([h[31 - k] & 1 for h in hashes], bool) for k in range(DIVISIONS)]
        return [s for s in sides if self._windows(s) >= FEWEST]

    def card(self) -> dict[str, Any]:
        """Plain JSON: what is in it, from where, under which licences, and what follows of it."""
        archives: dict[str, dict[str, Any]] = {}
        for name, licence, windows in zip(self.groups, self.licences, self.counts):
            row = archives.setdefault(name, {"clips": 0, "windows": 0, "licences": []})
            row["clips"] += 1
            row["windows"] += int(windows)
            row["licences"] = sorted({*row["licences"], licence})
        return {
            "format": FORMAT,
            "features": NAME,
            "library": self.origin,
            "split": "held_out",
            "clips": len(self.names),
            "seconds": round(self.seconds, 1),
            "archives": archives,
        }

    def save(self, path: str | Path) -> None:
        """Writes FILE.npz and its card FILE.json, atomically."""
        path = Path(path)
        head = {
            "format": FORMAT,
            "features": NAME,
            "library": self.origin,
            "seconds": self.seconds,
            "clips": [list(row) for row in zip(self.names, self.groups, self.licences)],
            "floors": self.floors,
        }
        arrays = {
            "counts": self.counts.astype(np.int32),
            "features": self.features.astype(np.float32),
            "table": self.table.astype(np.float32),
        }
        write_npz(path, arrays, head)
        bands = {name: self.band(name) for name in FIGURES}
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        card = {**self.card(), "sha256": digest, "bands": bands, "floors": self.floors}
        write_json(path.with_suffix(".json"), card)

    @staticmethod
    def load(path: str | Path = SHIPPED) -> Reference:
        """Reads what :meth:`save` wrote. Raises ValueError naming the file and what is wrong."""
        arrays, head = read_npz(path, ("counts", "features", "table"), what="likeness reference")
        if head.get("format") != FORMAT or head.get("features") != NAME:
            raise ValueError(f"{path} is no reference of this version's features: make it again")
        try:
            names, groups, licences = zip(*((str(a), str(b), str(c)) for a, b, c in head["clips"]))
            counts = arrays["counts"].astype(int)
            features, table = arrays["features"], arrays["table"]
            fits = features.shape == (counts.sum(), SIZE) and table.shape == (len(names), 3)
            if not fits or len(counts) != len(names) or not np.isfinite(features).all():
                raise ValueError("its arrays do not fit each other")
            origin, seconds = str(head["library"]), float(head["seconds"])
            floors = json.loads(json.dumps(head["floors"]))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} is not a readable likeness reference: {error}") from error
        return Reference(names, groups, licences, counts, features, table, seconds, origin, floors)


def reference_of(motions: Sequence[Motion], origin: str) -> Reference:
    """A reference of captured motions. Raises ValueError for ones that are too short together."""
    windows = [window_features(motion) for motion in motions]
    if sum(map(len, windows)) < 2 * FEWEST:
        raise ValueError(
            f"the clips to compare with have {sum(map(len, windows))} windows of a second, and "
            f"{2 * FEWEST} are needed: give more held-out clips"
        )
    rows = [figures(motion) for motion in motions]
    return Reference(
        names=tuple(m.name for m in motions),
        groups=tuple(m.group for m in motions),
        licences=tuple(m.licence for m in motions),
        counts=np.array([len(w) for w in windows]),
        features=np.concatenate(windows),
        table=np.array([[row[name] for name in FIGURES] for row in rows]),
        seconds=sum(m.seconds for m in motions),
        origin=origin,
    )


def reference_of_library(library: Library, *, open_only: bool = False) -> Reference:
    """A reference of the held-out clips of a library that show people.

    ``open_only`` leaves out those for non-commercial use. Raises ValueError if none is left.
    """
    held = library.split("held_out")
    keep = people_of(held, open_only=open_only)
    return reference_of(from_library(held.chosen(keep)), library.digest)


def people_of(library: Library, *, open_only: bool = False) -> list[int]:
    """Indices of the clips that show people; ``open_only`` leaves out those for non-commercial
    use."""
    return [
        i
        for i, o in enumerate(library.origins)
        if captured(o) and not (open_only and non_commercial(o.licence))
    ]


def non_commercial(licence: str) -> bool:
    """Whether a licence forbids commercial use, or is unknown and may."""
    words = licence.upper().replace("-", " ").replace("(", " ").split()
    return "NC" in words or licence == "unknown"


def main(args: Sequence[str] | None = None) -> None:
    """Makes a reference file of a library: ``--clips LIBRARY --out FILE.npz``."""
    import argparse

    parser = argparse.ArgumentParser(prog="python -m rl.likeness_reference", description=__doc__)
    parser.add_argument("--clips", required=True, help="a library that `mocap pack` wrote")
    parser.add_argument("--out", required=True, help="the file to write, FILE.npz")
    asked = parser.parse_args(args)
    made = reference_of_library(Library.load(asked.clips), open_only=True)
    made.save(asked.out)
    print(json.dumps({**made.card(), "floors": made.floors}, indent=1))


if __name__ == "__main__":
    main()
