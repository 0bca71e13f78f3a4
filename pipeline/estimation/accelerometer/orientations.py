"""What recordings say of the length of gravity: mean readings of rests, and single readings of slow turns.

A row is a mean reading ``y`` of ``n`` samples in one orientation:

* hand-held rests, found by themselves; each is an orientation of its own, with an error of its own;
* the dwells of a table's stop-and-go turns;
* the single samples of a table's continuous turns (n = 1).

The scatter of hand-held rests is white noise, tremor of each rest, and a bias wander. The error of the length of
gravity at rest i is ``e_i = a_i . (noise of its mean)``, with ``a_i = n_i^T L``, so that

    C_ij = (v_i + s^2) delta_ij + w^2 (a_i . a_j) B_ij(tau)

where

    v_i : variance of the mean by white noise, g^2
    s   : standard deviation of what each rest has of its own (tremor, creep), g
    w   : standard deviation of the bias wander, g; B its correlation between the rests, for the time tau

Rests that follow each other share the wander: taken for independent, they would claim too small an uncertainty of the
bias. Nobody knows s, w and tau, so each point of a grid is weighted by its restricted likelihood (Patterson & Thompson,
Biometrika 58, 1971) times what is believed of the wander, as in ``pipeline.estimation.engine``. For one s and
tau one eigendecomposition gives every w.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import CannotCalibrateError
from pipeline.estimation.engine import Posterior
from pipeline.estimation.gauss_markov import SURE, block_covariance
from pipeline.estimation.rest_means import holdout_interval, rest_means, sound_samples, split_rests
from pipeline.estimation.turns import stop_and_go
from pipeline.estimation.uncertainty_budget import scatter_contribution
from pipeline.model.kinematics import table_motion
from pipeline.signal.quiet_motion import creep_in
from pipeline.signal.rests import Rest, rests_from_table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.estimation.gauss_markov import Prior
    from pipeline.records import Contribution, Index, Integers, Mask, Recording, Values

SMALLEST_NOISE = 1e-9  # g, keeps the weights of a noise-free recording finite
TREMORS = np.geomspace(0.1, 3.0, 10)  # of the scatter beyond white noise that the residuals show
WANDERS = np.append(0.0, np.geomspace(0.125, 27.0, 14))  # of the one that is believed
TIMES = (0.5, 1.0, 2.0)  # of the correlation time that is believed


@dataclass(frozen=True)
class Orientations:
    """Rows of mean readings."""

    mean: Values  # (m, 3), g
    count: Integers  # (m,); samples of each row
    # g; standard deviation of a raw sample about the mean of its row, averaged over the axes; 0 where no row has two
    white: float
    parts: tuple[tuple[Recording, Mask], ...]  # the samples behind the rows, in order
    row: Index  # (k,); row of each of these samples
    by_hand: bool  # whether every row is a hand-held rest
    rests: tuple[tuple[Recording, Rest], ...]  # the rest behind each row, where all are rests of a hand-held recording
    held_out: tuple[tuple[Recording, Rest], ...]
    left_out: tuple[tuple[Recording, Rest], ...]

    @property
    def variance(self) -> Values:
        """Variance of each row's mean by white noise, an axis: (m,) array, g^2."""
        return np.asarray(max(self.white, SMALLEST_NOISE) ** 2 / self.count)

    def reading(self) -> Values:
        """Return the samples behind the rows: (k, 3) array, g."""
        readings = [np.asarray(recording.accelerometer)[keep] for recording, keep in self.parts]
        return np.concatenate(readings)


def orientations_of(recordings: Sequence[Recording], settings: Mapping[str, Any]) -> Orientations:
    """Collect the rows of all recordings made for the accelerometer.

    ``recordings``: those of role ``rests`` and ``accelerometer`` are used. ``settings``: sections ``table`` and
    ``procedure``. Raises ``CannotCalibrateError`` if no such recording holds readings of the accelerometer.
    """
    every = holdout_interval(recordings, settings)
    chosen = [r for r in recordings if r.role in {"rests", "accelerometer"} and r.accelerometer is not None]
    if not chosen:
        raise CannotCalibrateError(
            "nonlinear least squares needs the accelerometer at rest in many orientations, and no recording of role "
            "rests or accelerometer holds its readings: record some 24 rests, each in another orientation"
        )
    used: list[tuple[Recording, Rest]] = []
    held_out: list[tuple[Recording, Rest]] = []
    left_out: list[tuple[Recording, Rest]] = []
    by_hand = True
    for recording in chosen:
        on_table = _rests_on_table(recording, settings["table"])
        if on_table is None:
            split = split_rests(recording, every if recording.role == "rests" else 0)
            used += [(recording, rest) for rest in split.used]
            held_out += [(recording, rest) for rest in split.held_out]
            left_out += [(recording, rest) for rest in split.left_out]
        else:
            by_hand = False
            used += [(recording, rest) for rest in on_table]
    return _rows(used, held_out, left_out, by_hand=by_hand)


def without(orientations: Orientations, refused: Mapping[int, str]) -> Orientations:
    """Return the rows of hand-held rests without some of them, which count as left out, each with its reason."""
    keep = [pair for i, pair in enumerate(orientations.rests) if i not in refused]
    gone = [
        (recording, Rest(rest.start, rest.stop, accepted=False, reason=refused[i]))
        for i, (recording, rest) in enumerate(orientations.rests)
        if i in refused
    ]
    left_out = sorted([*orientations.left_out, *gone], key=lambda pair: (pair[0].name, pair[1].start))
    return _rows(keep, orientations.held_out, left_out, by_hand=orientations.by_hand)


def _rests_on_table(recording: Recording, table: Mapping[str, Any]) -> list[Rest] | None:
    """Return the dwells of a recording on a table, single samples of a continuous one, or None without a table."""
    motion = table_motion(recording, table) if recording.role == "accelerometer" else None
    if motion is None:
        return None
    if stop_and_go(motion):
        return rests_from_table(recording)
    return [Rest(i, i + 1) for i in np.flatnonzero(sound_samples(recording, "accelerometer")).tolist()]


def _rows(
    used: Sequence[tuple[Recording, Rest]],
    held_out: Sequence[tuple[Recording, Rest]],
    left_out: Sequence[tuple[Recording, Rest]],
    *,
    by_hand: bool,
) -> Orientations:
    means, counts, parts, rows = [np.empty((0, 3))], [np.empty(0, np.int64)], [], [np.empty(0, np.intp)]
    scatter, spare, first = 0.0, 0, 0
    for recording in dict.fromkeys(id(r) for r, _ in used):
        own = [(r, rest) for r, rest in used if id(r) == recording]
        source, rests = own[0][0], [rest for _, rest in own]
        mean, count = rest_means(source, rests)
        keep, row = _samples(source, rests)
        gain = float(source.filter.get("noise_gain", 1.0)) or 1.0
        if by_hand:  # where a unit may creep
            creeps = [creep_in(source, rest.start, rest.stop) for rest in rests]
            squares, free = sum(float(c.squares.sum()) for c in creeps), sum(c.freedom for c in creeps)
        else:
            squares = float(np.sum((np.asarray(source.accelerometer)[keep] - mean[row]) ** 2))
            free = int(np.sum(np.maximum(count - 1, 0)))
        scatter += squares / (3.0 * gain**2)
        spare += free
        means.append(mean)
        counts.append(count)
        parts.append((source, keep))
        rows.append(row + first)
        first += len(rests)
    mean, count, row = np.concatenate(means), np.concatenate(counts), np.concatenate(rows)
    filled = count > 0
    return Orientations(
        mean=mean[filled],
        count=count[filled],
        white=float(np.sqrt(scatter / spare)) if spare else 0.0,
        parts=tuple(parts),
        row=(np.cumsum(filled) - 1)[row],
        by_hand=by_hand,
        rests=tuple(pair for pair, some in zip(used, filled, strict=True) if some) if by_hand else (),
        held_out=tuple(held_out),
        left_out=tuple(left_out),
    )


def _samples(recording: Recording, rests: Sequence[Rest]) -> tuple[Mask, Index]:
    """Return which samples of a recording belong to its rests, and the row of each of these."""
    edges = np.array([[rest.start, rest.stop] for rest in rests])
    inside = np.zeros(recording.samples + 1, np.intp)
    np.add.at(inside, edges[:, 0], 1)
    np.add.at(inside, edges[:, 1], -1)
    began = np.zeros(recording.samples, np.intp)
    began[edges[:, 0]] = 1
    label = np.cumsum(began) - 1
    keep = (np.cumsum(inside[:-1]) > 0) & sound_samples(recording, "accelerometer")
    return keep, label[keep]


@dataclass(frozen=True)
class RestErrors:
    """The errors of a fit to m rests."""

    error: Values  # (m,), g
    derivative: Values  # (m, p); of the length of gravity with respect to the parameters
    along: Values  # (m, 3); a_i
    variance: Values  # (m,), g^2; v_i
    between: float  # g; what they scatter beyond white noise, taken for independent
    # each (m,), s
    start: Values
    length: Values
    joined: Mask  # (m, m); whether the time between two rests is known


def rest_scatter(rests: RestErrors, gain: Values, prior: Prior) -> Contribution:
    """Return what the rests' scatter contributes to ``gain @ errors``.

    ``gain``: (p, m). ``prior``: of the bias wander.
    """
    spare = len(rests.error) - rests.derivative.shape[1]
    weight, covariances = rest_candidates(rests, gain, prior)
    covariance, freedom = Posterior(weight, covariances, float("inf")).averaged()
    parts = {
        "white noise": np.sqrt(np.minimum(np.diag(gain * rests.variance @ gain.T), np.diag(covariance))),
    }
    parts["bias wander and scatter of the rests"] = np.sqrt(np.diag(covariance) - parts["white noise"] ** 2)
    whole = scatter_contribution(covariance, float(spare), parts)
    return whole.with_freedom(freedom)


def rest_candidates(rests: RestErrors, gain: Values, prior: Prior) -> tuple[Values, Values]:
    """Return the weight of each candidate of the noise, (k,), and the covariance of ``gain @ errors``, (k, p, p)."""
    Q = np.linalg.qr(rests.derivative, mode="complete")[0][:, rests.derivative.shape[1] :]
    z = Q.T @ rests.error
    tremors = np.append(0.0, max(rests.between, 0.3 * float(np.sqrt(np.median(rests.variance)))) * TREMORS)
    wanders = prior.wander * WANDERS if prior.wander > 0.0 else np.zeros(1)
    belief = prior.log_belief(wanders) if prior.wander > 0.0 else np.zeros(1)
    scores, covariances = [], []
    for time in TIMES if prior.wander > 0.0 else (1.0,):
        B = np.where(rests.joined, block_covariance(rests.start, rests.length, time * prior.time), 0.0)
        B = B * (rests.along @ rests.along.T)
        slow = gain @ B @ gain.T
        for s in tremors:  # as nobody states a tremor, none at all is believed before any
            none = 0.0 if s > 0.0 else float(np.log(SURE * len(TREMORS)))
            own = rests.variance + s**2
            scores.append(_restricted_likelihood(z, Q.T @ (own[:, None] * Q), Q.T @ B @ Q, wanders**2) + belief + none)
            covariances.append(gain * own @ gain.T + (wanders**2)[:, None, None] * slow)
    weight = np.exp(np.concatenate(scores) - np.max(scores))
    return weight / weight.sum(), np.concatenate(covariances)


def _restricted_likelihood(z: Values, D: Values, E: Values, variances: Values) -> Values:
    """Return the log likelihood of ``z ~ N(0, D + v E)`` for each v: (k,) array."""
    root = np.linalg.cholesky(D)
    half = np.linalg.solve(root, E)
    e, U = np.linalg.eigh(np.linalg.solve(root, half.T))
    y = U.T @ np.linalg.solve(root, z)
    spectrum = 1.0 + np.outer(variances, np.clip(e, 0.0, None))
    logarithm = 2.0 * float(np.sum(np.log(np.diag(root))))
    return np.asarray(-0.5 * (np.sum(np.log(spectrum) + y**2 / spectrum, axis=1) + logarithm))
