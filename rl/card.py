"""The JSON cards that stand beside weights."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np


def card_text(card: dict[str, Any]) -> str:
    """A card as JSON: the statistics in as many digits as their float32 has, and each list of
    numbers on one line. Raises ValueError for numbers that are not finite."""
    short = dict(card)
    for name in ("obs_mean", "obs_std"):
        if name in card:
            short[name] = [float(str(np.float32(x))) for x in card[name]]
    text = json.dumps(short, indent=1, allow_nan=False)
    return re.sub(r"\[[-+.\deE,\s]+\]", lambda found: " ".join(found[0].split()), text)
