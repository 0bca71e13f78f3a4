"""Identifies the noise of simulated mixtures of known terms, and counts right compositions and intervals that cover.

    python benchmarks/noise_mixtures.py --count 1000 --seed 1

Each mixture has white noise and up to three further terms of random sizes, and is simulated in the time domain: a walk
by its increments, flicker noise by fractional integration of eight times as many samples (Kasdin, Proceedings of the
IEEE 83, 1995), a Gauss-Markov process by its recursion. A mixture is counted under *long enough* where, by the exact
spectrum of the truth, every other composition loses so much of the criterion that chance makes up for it in 1 % of
recordings: ``BIC_other - BIC_true > 2 * 2.33 sqrt(lambda)``, with lambda the expected gain of -2 log L, whose standard
deviation is ``2 sqrt(lambda)``.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pandas as pd
from scipy.signal import fftconvolve, lfilter

from imu_research.figures import clopper_pearson, share, write_figures
from pipeline.core.records import Recording
from pipeline.estimation.noise_identification import identify_noise
from pipeline.estimation.noise_search import CompositionSearch, best_of, count_of
from pipeline.estimation.noise_terms import STOCHASTIC, solved, spectrum_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Values = NDArray[np.float64]

Term = tuple[Any, ...]  # letter and parameters
SURE = 2.33  # standard deviations: 1 % beyond, one-sided
LONG = 8  # samples of white noise behind each sample of flicker noise
NAMES = {
    "Q": "quantisation", "N": "white", "B": "bias_instability", "K": "random_walk", "G": "gauss_markov", "R": "ramp",
    "S": "sinusoid",
}  # fmt: skip
RARE = {"Q": 1, "B": 2, "K": 2, "G": 2, "R": 1, "S": 1}  # weights of the draw


def drawn(rng: np.random.Generator) -> tuple[int, float, list[Term]]:
    """Return samples, interval, and terms (letter and parameters) of a mixture; N is 1."""
    n = int(np.exp(rng.uniform(np.log(5e3), np.log(1e5))))
    dt = float(rng.choice([0.01, 0.1]))
    length = n * dt
    further = rng.choice(4, p=[0.1, 0.3, 0.3, 0.3])
    letters = rng.choice([*RARE], size=further, p=np.array([*RARE.values()]) / sum(RARE.values()))
    terms: list[Term] = [("N", 1.0)]
    counts = Counter(letters.tolist())

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    for letter, many in counts.items():
        for _ in range(many if letter in "GS" else 1):
            corner = between(10.0 / length, 0.02 / dt)  # where the term meets white noise
            if letter == "Q":
                terms.append(("Q", 0.5 * np.sqrt(dt * between(0.5, 20.0))))
            elif letter == "B":
                terms.append(("B", np.sqrt(2.0 * np.pi * corner)))
            elif letter == "K":
                terms.append(("K", 2.0 * np.pi * corner))
            elif letter == "G":
                tau = between(10.0 * dt, length / 30.0)
                terms.append(("G", np.sqrt(between(2.0, 300.0) / (2.0 * tau)), tau))
            elif letter == "R":
                terms.append(("R", between(6.0, 300.0) * np.sqrt(12.0 / length**3) * rng.choice([-1.0, 1.0])))
            else:
                amplitude = np.sqrt(between(60.0, 3000.0) * 2.0 / length)
                terms.append(("S", amplitude, between(50.0 / length, 0.4 / dt), rng.uniform(0.0, 2.0 * np.pi)))
    return n, dt, terms


def simulated(rng: np.random.Generator, n: int, dt: float, terms: list[Term]) -> Values:
    out, t = np.zeros(n), np.arange(n) * dt
    for letter, size, *more in terms:
        white = rng.standard_normal(n)
        if letter == "N":
            out += size / np.sqrt(dt) * white
        elif letter == "Q":
            out += np.diff(size * rng.standard_normal(n + 1)) / dt
        elif letter == "K":
            out += np.cumsum(size * np.sqrt(dt) * white)
        elif letter == "B":
            k = np.arange(1, LONG * n)
            weights = np.concatenate([[1.0], np.cumprod((k - 0.5) / k)])
            out += size * fftconvolve(rng.standard_normal(LONG * n), weights)[(LONG - 1) * n : LONG * n]
        elif letter == "G":
            phi = np.exp(-dt / more[0])
            white[1:] *= np.sqrt(1.0 - phi**2)
            out += size * lfilter([1.0], [1.0, -phi], white)
        elif letter == "R":
            out += size * t
        else:
            out += size * np.cos(2.0 * np.pi * more[0] * t + more[1])
    return out


def long_enough(n: int, dt: float, terms: list[Term]) -> bool:
    """Return whether the exact spectrum tells the composition from all others, as in the docstring."""
    t = np.arange(n) * dt - 0.5 * n * dt
    sines = [(a, f, p) for letter, a, *more in terms if letter == "S" for f, p in [more]]
    ramp = sum(size for letter, size, *_ in terms if letter == "R")
    waves = [g(2.0 * np.pi * f * t) for _, f, _ in sines for g in (np.cos, np.sin)]
    exact = ramp * t + sum((a * np.cos(2.0 * np.pi * f * t + p) for a, f, p in sines), np.zeros(n))
    spectrum = spectrum_of([np.stack([exact, t / t[-1], *waves], axis=1)[None]], dt)
    w = spectrum.omega
    s = 2.0 * np.sin(w / 2.0)
    noise = np.zeros_like(w)
    for letter, size, *more in terms:
        if letter == "G":
            phi = np.exp(-dt / more[0])
            noise += size**2 * (1.0 - phi**2) / (1.0 + phi**2 - 2.0 * phi * np.cos(w))
        elif letter not in "RS":
            noise += size**2 * {"Q": s**2 / dt**2, "N": 1.0 / dt + 0.0 * s, "B": 1.0 / s, "K": dt / s**2}[letter]
    spectrum.products[0, :, 0, 0] += noise * spectrum.count
    required, penalty = tuple(range(2, 2 + len(waves))), np.log(n - 1)
    for j in range(len(sines)):  # each sinusoid by itself
        gain = sines[j][0] ** 2 * n / (2.0 * np.interp(2.0 * np.pi * sines[j][1] * dt, w, noise))
        if gain - 3.0 * penalty < 2.0 * SURE * np.sqrt(gain) or sines[j][1] * n * dt < 32:
            return False
    if any(abs(a[1] - b[1]) * n * dt < 20 for i, a in enumerate(sines) for b in sines[:i]):
        return False
    kinds = tuple(sorted(STOCHASTIC.index(NAMES[letter]) for letter, *_ in terms if letter not in "RS"))
    columns = (*required, 1) if ramp else required
    order = sorted((term for term in terms if term[0] not in "RS"), key=lambda x: STOCHASTIC.index(NAMES[x[0]]))
    truth = np.array([2.0 * np.log(x[1]) for x in order] + [np.log(x[2]) if x[0] == "G" else 0.0 for x in order])
    search = CompositionSearch(spectrum, 0)
    solved(spectrum, search.fit([(kinds, truth)], columns))
    best = solved(spectrum, best_of(search, required, [1]))
    if (best.kinds, best.columns) != (kinds, columns):
        return False
    for other in search.found.values():
        fewer = count_of(best.kinds, best.columns) - count_of(other.kinds, other.columns)
        gain = other.bic - best.bic + penalty * fewer
        if other is not best and other.bic - best.bic < 2.0 * SURE * np.sqrt(max(gain, 0.0)):
            return False
    return True


def pairs(terms: list[Term], found: dict[str, Any]) -> list[tuple[str, float, list[float]]]:
    """Return name, truth and interval of each parameter of an axis, for the right composition."""
    out = []
    for letter, name in NAMES.items():
        true = [term for term in terms if term[0] == letter]
        if letter in "GS":
            ordered = sorted(true, key=lambda x: x[2])
            listed = sorted(found[name], key=lambda x: x[SECOND[name]]["value"])
            for (_, size, second, *_), part in zip(ordered, listed, strict=True):
                out += [
                    (name, size, part["interval"]),
                    (f"{name} {SECOND[name]}", second, part[SECOND[name]]["interval"]),
                ]
        else:
            out += [(name, size, found[name]["interval"]) for _, size in true]
    return out


SECOND = {"gauss_markov": "correlation_time_s", "sinusoid": "frequency_hz"}


def interval(k: int, n: int) -> str:
    """Return the 95 % interval of a share by Clopper and Pearson."""
    low, high = clopper_pearson(k, n) if n else (0.0, 1.0)
    return f"{k} of {n}: {100 * k / max(n, 1):.1f} % ({100 * low:.1f} to {100 * high:.1f} %)"


def main() -> None:
    """Draw mixtures until ``count`` of them are long enough."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--figures", type=Path, help="file for the shares with their 95 % intervals")
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    right, short_right, drawn_total, covered, wrong = [], [], 0, defaultdict(list), Counter()
    limits, spent = [], 0.0
    while len(right) < options.count:
        n, dt, terms = drawn(rng)
        values = simulated(rng, n, dt, terms)
        drawn_total += 1
        enough = long_enough(n, dt, terms)
        started = time.process_time()
        found = axis_of(values, dt)
        spent += time.process_time() - started
        truth, got = sorted(NAMES[t[0]] for t in terms), sorted(found["ranking"][0]["terms"])
        (right if enough else short_right).append(truth == got)
        for letter in "QBK":
            part = found["terms"][NAMES[letter]]
            if part["value"] is None and enough:
                limits.append(sum(t[1] for t in terms if t[0] == letter) <= part["upper_limit"])
        if truth == got:
            for name, true, (low, high) in pairs(terms, found["terms"]):
                covered[name, enough].append(low <= true <= high)
        elif enough:
            wrong[" ".join(truth), " ".join(got)] += 1
            if options.verbose:
                best = [(r["terms"], round(r["delta_bic"], 1)) for r in found["ranking"][:4]]
                print(n, dt, terms, got, best, flush=True)
    print(f"mixtures drawn: {drawn_total}; CPU of the identification, s an axis: {spent / drawn_total:.3f}")
    print("right composition, long enough:", interval(sum(right), len(right)))
    print("right composition, the others:", interval(sum(short_right), len(short_right)))
    told(covered)
    print("upper limits that hold:", interval(sum(limits), len(limits)))
    held = [v for (_, enough), values in covered.items() if enough for v in values]
    shares = share("composition of the noise is right", pd.Series(right), ">= 95 %")
    write_figures(options.figures, [*shares, *share("intervals that hold the truth", pd.Series(held), ">= 95 %")])
    for (expected, got), k in wrong.most_common(15):
        print(f"  {k}: {expected} -> {got}")


def told(covered: dict[tuple[str, bool], list[bool]]) -> None:
    for enough in (True, False):
        every = [v for (_, e), values in covered.items() if e == enough for v in values]
        print(f"intervals that cover, {'long enough' if enough else 'the others'}:", interval(sum(every), len(every)))
        for name in sorted({name for name, e in covered if e == enough}):
            print(f"  {name}:", interval(sum(covered[name, enough]), len(covered[name, enough])))


def axis_of(values: Values, dt: float) -> dict[str, Any]:
    zero = np.zeros_like(values)
    time_ns = np.rint(np.arange(len(values)) * dt * 1e9).astype(np.int64)
    recording = Recording("static", "static", None, time_ns, gyroscope=np.stack([values, zero, zero], axis=1))
    return identify_noise([recording])["gyroscope"]["axes"]["x"]


if __name__ == "__main__":
    main()
