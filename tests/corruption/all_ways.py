"""All ways in which a good unit is corrupted: class, function, parameters, and the good units that it applies to."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import ways_of_benches as bench
import ways_of_readings as reading
import ways_of_reference as reference
import yaml
from good_bench import BASES, TABLE, good_unit
from unit_copy import NotApplicableError

if TYPE_CHECKING:
    from collections.abc import Callable

    from unit_copy import Copy

ON = {
    "table": tuple(TABLE),
    "attitudes": tuple(b for b in TABLE if b != "continuous_rate"),
    "static": tuple(b for b in TABLE if b != "no_static"),
    "mcap": tuple(b for b in TABLE if "mcap" in b),
    "hand": ("by_hand",),
}


@dataclass(frozen=True)
class Way:
    """One way to corrupt: ``function(copy, **parameters)``, for good units of ``bases``."""

    kind: str
    function: Callable[..., None]
    parameters: dict[str, Any]
    bases: tuple[str, ...]

    @property
    def name(self) -> str:
        """What identifies it."""
        said = ", ".join(f"{k}={v:.4g}" if isinstance(v, float) else f"{k}={v}" for k, v in self.parameters.items())
        return f"{self.function.__name__}({said})"


def single_ways() -> list[Way]:
    """Return the ways that change one thing, as ``ways.yaml`` lists them."""
    listed = yaml.safe_load((Path(__file__).parent / "ways.yaml").read_text(encoding="utf-8"))
    return [way for kind, entries in listed.items() for entry in entries for way in _expanded(kind, dict(entry))]


def _expanded(kind: str, entry: dict[str, Any]) -> list[Way]:
    """Return the ways of one entry: all combinations of what its lists hold."""
    on = entry.pop("for", "table")
    bases = ON[on] if isinstance(on, str) else tuple(on)
    ((name, parameters),) = entry.items()
    function = next(getattr(module, name) for module in (reading, reference, bench) if hasattr(module, name))
    lists = [value if isinstance(value, list) else [value] for value in parameters.values()]
    return [Way(kind, function, dict(zip(parameters, one, strict=True)), bases) for one in itertools.product(*lists)]


def corrupted(number: int, seed: int, ways: list[Way]) -> Copy:
    """Return unit ``number``: way by way, then at random, half of them with a second way on top."""
    rng = np.random.default_rng([seed, number])
    first = ways[_in_turn(ways, seed)[number]] if number < len(ways) else ways[int(rng.integers(len(ways)))]
    chosen = [first]
    if number >= len(ways) and rng.random() < 0.5:
        chosen.append(ways[int(rng.integers(len(ways)))])
    for _ in range(20):
        common = [b for b in BASES if all(b in way.bases for way in chosen)]
        if common:
            base = str(rng.choice(common))
            try:
                return _applied(chosen, base, number, seed, rng, varied=number >= len(ways))
            except NotApplicableError:
                pass
        elif len(chosen) > 1:
            chosen[1] = ways[int(rng.integers(len(ways)))]
    raise NotApplicableError(f"no good unit takes {[way.name for way in chosen]}")


def _in_turn(ways: list[Way], seed: int) -> list[int]:
    """Return the order of the first round: a way of each class, then another one of each."""
    kinds: dict[str, list[int]] = {}
    for index in np.random.default_rng(seed).permutation(len(ways)).tolist():
        kinds.setdefault(ways[index].kind, []).append(index)
    return [i for group in itertools.zip_longest(*kinds.values()) for i in group if i is not None]


def _applied(chosen: list[Way], base: str, number: int, seed: int, rng: np.random.Generator, *, varied: bool) -> Copy:
    copy = good_unit(base, 1000 * seed + number, f"u{number:04d}", varied=varied)
    copy.of_other = partial(good_unit, base, 500_000 + 1000 * seed + number, varied=varied)
    copy.rng = rng
    said = []
    unseen = []
    harmless = []
    for way in chosen:
        copy.said, copy.harmless, copy.unseen = {}, False, ""
        way.function(copy, **way.parameters)
        said.append(copy.said)
        unseen.append(copy.unseen)
        harmless.append(copy.harmless)
    copy.kind = " + ".join(dict.fromkeys(way.kind for way in chosen)) if len(chosen) == 1 else "two at once"
    copy.way = " + ".join(way.name for way in chosen)
    copy.said = {k: v for each in said for k, v in each.items()}
    copy.unseen = "; ".join(u for u in unseen if u)
    copy.harmless = all(harmless)
    return copy
