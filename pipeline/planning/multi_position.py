"""The smallest size of each effect that rests and moves by hand would show, found by drawing noise.

    r = a Z d + C^1/2 w,    w standard normal, C the covariance by the data sheet, and a unit that rests firmly

Each draw of w goes with signs d of its own through the likelihoods of ``estimation.multi_position``, at any size a
without a new simulation, as all sums of squares are polynomials in a. Equations are few by hand, and their noise is not
known beforehand, so that the large-sample formulas of ``pipeline.planning.detection_limits`` do not hold here.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import CannotCalibrateError, NotObservableError
from pipeline.estimation.accelerometer import nonlinear_least_squares
from pipeline.estimation.design import Term
from pipeline.estimation.multi_position.likelihood import NoiseHypothesis, log_likelihood, project_out
from pipeline.estimation.multi_position.result import model_of
from pipeline.estimation.multi_position.selection import select
from pipeline.estimation.selection import ALIKE, GATE_BIC, GATE_P
from pipeline.planning.detection_limits import ALMOST_SURE, PARTLY, Detection, limits_or_none, smallest
from pipeline.records import SensorCalibration

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from pipeline.estimation.multi_position.likelihood import ProjectedCandidates
    from pipeline.estimation.multi_position.selection import Selection
    from pipeline.planning.plan import SimulatedProcedure
    from pipeline.records import Noise

    Values = NDArray[np.float64]

DRAWS = 64


def select_in_rehearsal(sensor: str, simulated: SimulatedProcedure) -> Selection:
    """Return what the selection makes of a simulated procedure by hand, in which there is nothing to find.

    Raises
    ------
    NotObservableError
        If bias and matrix cannot be determined, or there are no rests.
    """
    settings: Mapping[str, Any] = {
        "sensor": simulated.sheets,
        "table": simulated.table,
        "procedure": simulated.procedure,
        "effects": {"accelerometer": [], "gyroscope": []},
    }
    noise = simulated.noise[sensor]
    start = nonlinear_least_squares.fit(simulated.recordings, None, settings)
    other = None
    if sensor == "gyroscope":
        start, other = SensorCalibration(sensor), start
    try:
        model = model_of(simulated.recordings, start, noise, settings, other)
    except CannotCalibrateError as lack:
        raise NotObservableError(lack.message) from lack
    if model is None:
        raise NotObservableError(f"no recording holds a rest with readings of the {sensor}")
    return select(model, start, [], noise, simulated.sheets[sensor])


class ExpectedSelection:
    """What a selection by hand is expected to see.

    Parameters
    ----------
    selection : Selection
        Of a simulated.
    noise : Noise
        That the readings will have.
    """

    def __init__(self, selection: Selection, noise: Noise) -> None:
        model = selection.model
        self.sensor = model.sensor
        self.limits = limits_or_none(selection.candidates, model.sensor, selection.limits)
        self.terms = [Term(this, v) for this in selection.candidates for v in this.starts(model.sensor)]
        self.names = [this.name for this in selection.candidates]
        equations = model.equations(replace(selection.fits[0].state, terms=()), self.terms)
        ratio = float(np.sqrt(np.mean(noise.wander**2) / np.mean(noise.white**2)))
        C = equations.covariance(NoiseHypothesis(ratio, noise.correlation_time, (0.0,) * model.kinds, 0.0))
        rng = np.random.default_rng(0)
        drawn = np.linalg.cholesky(C) @ rng.standard_normal((len(C), DRAWS))
        together = replace(equations, candidates=[*equations.candidates, drawn])
        self.found: ProjectedCandidates = project_out(together, selection.hypotheses)
        self.drawn = self.found.raw[-1]
        self.equations = len(C)
        at_rest = self._scores(np.sum(self.drawn**2, axis=1))
        self.at = int(np.argmax(np.mean(at_rest, axis=1)))
        self.counts = [self._count(j) for j in range(len(self.terms))]
        self.factors = [
            self.found.correction(j, self.at, v, equations.scatter) if v else 0.0 for j, v in enumerate(self.counts)
        ]

        self.of_draws = [self._along(j, self.drawn) for j in range(len(self.terms))]

    def _count(self, j: int) -> int:
        shown = self.found.count(j, self.at)
        return shown + len(self.terms[j].effect.nonlinear) if shown else 0

    def _scores(self, rss: Values) -> Values:
        return log_likelihood(rss, self.drawn.shape[1], self.found.log_determinant[:, None])

    def detection(self, name: str, *, half_only: bool = False) -> Detection | None:
        """Return what would be found of an effect; None where rests and moves do not show it.

        Parameters
        ----------
        name : str
        half_only : bool
            Leave out ``sure`` and ``named``, which are then infinite.
        """
        places = [j for j, term in enumerate(self.terms) if term.effect.name == name and self.factors[j] > 0.0]
        if not places:
            return None
        j = min(places, key=self._far_from_typical)
        sizes = self._unit_sizes(j)
        signs = np.random.default_rng(1).choice([-1.0, 1.0], (DRAWS, len(sizes)))
        signal = self.found.raw[j] @ (signs * sizes).T
        own = self._squares(j, signal)
        rivals, others = self._rivals(j, signal)
        total = np.sum(self.drawn**2, axis=1), np.sum(self.drawn * signal, axis=1), np.sum(signal**2, axis=1)

        def bic(share: float, i: int, squares: tuple[Values, Values, Values]) -> Values:
            rss = total[0] + 2.0 * share * total[1] + share**2 * total[2]
            left = rss - (squares[0] + 2.0 * share * squares[1] + share**2 * squares[2])
            gain = self._scores(left).max(axis=0) - self._scores(rss).max(axis=0)
            brought: Values = 2.0 * self.factors[i] * gain - self.counts[i] * float(np.log(self.equations))
            return brought

        def found(share: float) -> Values:
            return self._passes(bic(share, j, own), self.counts[j])

        def named(share: float) -> Values:
            mine = bic(share, j, own)
            best = np.max([bic(share, i, o) for i, o in zip(rivals, others, strict=True)], axis=0, initial=-np.inf)
            ahead: Values = np.where(mine >= best, self._passes(mine, self.counts[j]), 0.0)
            return ahead

        half = smallest(found, 0.5)
        taken = None
        if np.isfinite(half):
            mine = bic(half, j, own)
            ahead = [float(np.mean(bic(half, i, o) > mine)) for i, o in zip(rivals, others, strict=True)]
            if max(ahead, default=0.0) > 0.5:
                taken = self.terms[rivals[int(np.argmax(ahead))]].effect.name
        return Detection(
            name,
            sizes,
            half,
            np.inf if half_only else smallest(found, ALMOST_SURE),
            np.inf if half_only else smallest(named, 0.5),
            taken,
            self._alike(signal, rivals, others),
        )

    def _far_from_typical(self, j: int) -> float:
        """Return how far a start's time constants are from half their limits, as a logarithm."""
        this, values = self.terms[j].effect, self.terms[j].values
        fixed = np.array([p.name in this.nonlinear for p in this.parameters(self.sensor)])
        typical = 0.5 * self.limits[this.name][fixed]
        return float(np.sum(np.abs(np.log(values[fixed] / typical))))

    def _unit_sizes(self, j: int) -> Values:
        """Return the limits of a term's linear parameters, 1 where there is none and 0 for time constants."""
        this = self.terms[j].effect
        limits = np.where(np.isfinite(self.limits[this.name]), self.limits[this.name], 1.0)
        linear = [p.name not in this.nonlinear for p in this.parameters(self.sensor)]
        return np.where(linear, limits, 0.0)

    def _rivals(self, j: int, signal: Values) -> tuple[list[int], list[tuple[Values, Values, Values]]]:
        """Return the candidates that reproduce a part of the signals, and what they take."""
        name = self.terms[j].effect.name
        able = [i for i, t in enumerate(self.terms) if t.effect.name != name and self.factors[i] > 0.0]
        part = PARTLY * float(np.sum(signal[self.at] ** 2))
        taken = {i: squares for i in able if np.sum((squares := self._squares(i, signal))[2][self.at]) > part}
        return list(taken), list(taken.values())

    def _along(self, i: int, what: Values) -> Values:
        """Return draws or signals, (t, n, s), along the directions of candidate i: (t, p, s) array."""
        found: Values = self.found.orthonormal[i].transpose(0, 2, 1) @ (self.found.raw[i].transpose(0, 2, 1) @ what)
        return found

    def _squares(self, i: int, signal: Values) -> tuple[Values, Values, Values]:
        """Return what candidate i takes of draws and signals: squares, products and squares, each (t, s)."""
        of_draws, of_signal = self.of_draws[i], self._along(i, signal)
        return np.sum(of_draws**2, axis=1), np.sum(of_draws * of_signal, axis=1), np.sum(of_signal**2, axis=1)

    def _alike(
        self, signal: Values, rivals: list[int], squares: list[tuple[Values, Values, Values]]
    ) -> dict[str, float]:
        power, shares = float(np.sum(signal[self.at] ** 2)), dict[str, float]()
        for i, (_, _, own) in zip(rivals, squares, strict=True):
            name, share = self.terms[i].effect.name, float(np.sum(own[self.at])) / power
            shares[name] = max(min(share, 1.0), shares.get(name, 0.0))
        return {n: s for n, s in sorted(shares.items(), key=lambda item: -item[1]) if s > ALIKE}

    def _passes(self, bic: Values, k: int) -> Values:
        """Return 1 where a delta BIC passes the gate, else 0."""
        from scipy.special import chdtrc  # noqa: PLC0415  (0.1 s that only plans pay)

        gain = bic + k * float(np.log(self.equations))
        significant = chdtrc(k, np.maximum(gain, 0.0)) * len(self.names) < GATE_P
        return np.asarray((bic > GATE_BIC) & significant, float)
