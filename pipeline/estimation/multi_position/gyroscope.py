"""Equations of the gyroscope: zero rate at rest, and moves whose integrated rate rotates gravity to its new direction.

    at rest:  r = (y - b - z - K w) / s_e,     dr/db = -1/s_e,   dr/dp = -dz/dp / s_e
    a move:   r = W E^T (u_after - A_0 u_before),   omega = M (y - b - z)

where

    y, b, M : reading and bias, deg/s, and matrix
    z, p    : effects and their parameters; in a move with the specific force of the rest, rotated along the move
    w       : creep rate of the unit in a rest, across gravity by the accelerometer (K = M^-1); the rate about gravity
              is unknown and of the same size (``pipeline.signal.quiet_motion.posterior_creep_rates``)
    u       : direction of gravity by the calibrated accelerometer (``gravity``); A_0 as in ``moves``
    E       : two directions across u_after; W whitens the integrated noise of the gyroscope, the uncertainty of the
              rate between samples, and the noise of the accelerometer

Two moves share the error of the direction at the rest between them, and all moves share the errors of the
accelerometer's calibration: ``du = (1 - u u^T) (M_a dy - M_a db_a + dM_a v_a) / G``. The frame is that of the
accelerometer's matrix. One move does not show a turn about the vertical; other moves do, because the vertical has
another direction in the body. If the procedure states the total angle of turns, their equations are added
(``faces_and_turns``).

Source: Tedaldi, Pretto & Menegatti, ICRA 2014, eq. 12.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import CannotCalibrateError, NotObservableError
from pipeline.estimation.engine import draw_normal
from pipeline.estimation.multi_position.accelerometer import SMALLEST_NOISE, white_of
from pipeline.estimation.multi_position.faces_and_turns import Turns, require_turns, turns_of
from pipeline.estimation.multi_position.model import Block, Equations, State, effect_readings, motion_of, stacked
from pipeline.estimation.multi_position.moves import Gravity, Moves, moves_of, observed_rests, tangents, to_the_end
from pipeline.model.kinematics import skew

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.estimation.design import Term
    from pipeline.estimation.multi_position.fit import Fit
    from pipeline.estimation.rest_means import Rests
    from pipeline.records import Mask, Motion, Noise, Recording, SensorCalibration, Values

FEWEST_MOVES = 6  # two equations each, for the nine of the matrix
ROUNDS = 6  # of effects that depend on the rate
SETTLED_DPS = 1e-7  # change of the rate that ends these rounds
MOVED = "accelerometer_moved"
MANY = 1e6  # degrees of freedom beyond which Student's t is normal to 1e-6
DRAWS, TAIL = 4000, 0.005  # as of the 99 % interval of other held-out errors: 20 draws are beyond it


class GyroscopeModel:
    """Equations of the gyroscope's rests and moves.

    ``rests``: all, also held-out ones, at which a move may begin. ``gravity``: at each rest, by the accelerometer.
    ``fewest``: smallest number of moves that are used. ``turns``: of a stated total angle.
    """

    sensor = "gyroscope"
    known_by_limit: Mapping[str, float] = {}  # as of the accelerometer's model

    def __init__(
        self,
        rests: Rests,
        moves: Moves | None,
        gravity: Gravity,
        noise: Noise | None,
        *,
        fewest: int = FEWEST_MOVES,
        turns: Turns | None = None,
    ) -> None:
        force = gravity.force
        self.white = np.maximum(white_of(rests, noise), SMALLEST_NOISE)
        self.rests, self.force = rests.select(~rests.held_out), force[~rests.held_out]
        self.held, self.held_force = rests.select(rests.held_out), force[rests.held_out]
        self.moves, self.turns = moves if moves is not None and moves.count >= fewest else None, turns
        self.kinds = 1 if self.moves is None else 2
        self.directions = np.eye(12)[:, : 3 if self.moves is None and turns is None else 12]
        self.rests_equations = 3 * len(self.rests.time)
        self.of_moves = slice(self.rests_equations, self.rests_equations + (2 * self.moves.count if self.moves else 0))
        self.gravity = float(np.median(np.linalg.norm(force, axis=1)))
        if self.moves is not None:
            self.before, self.after = gravity.at_end[self.moves.before], gravity.at_start[self.moves.after]
            u = force / np.linalg.norm(force, axis=1, keepdims=True)
            across = np.eye(3) - u[:, :, None] * u[:, None, :]
            self.spread = np.degrees(gravity.spread / self.gravity)[:, None, None] * across
            self.across = across
            self.ends = np.degrees(gravity.ends / self.gravity)[:, None, None] * across
            self.shared = np.degrees(across @ gravity.shared / self.gravity)
            self.excess = np.zeros(self.moves.count)
        self.every = rests
        self.known: dict[str, Any] = {"gravity": gravity, "noise": noise, "fewest": fewest, "turns": turns}

    def equations(self, state: State, candidates: Sequence[Term] = ()) -> Equations:
        """Return the linearised equations at given parameters."""
        blocks = [self._at_rest(state)]
        if self.moves is not None:
            blocks.append(self._of_moves(state))
        if self.turns is not None:
            blocks.append(self.turns.equations(state, self.white))
        return stacked(blocks, self, state, candidates)

    def samples(self) -> float:
        """Return the number of samples in the equations."""
        return float(self.rests.count.sum()) + (0.0 if self.moves is None else float(np.sum(self.moves.weight > 0)))

    def held_out_error(self, state: State) -> float | None:
        """Return the rms of the rate at held-out rests, deg/s; None if there are none."""
        if len(self.held.time) == 0:
            return None
        nothing = np.zeros_like(self.held_force)
        motion = motion_of(self.held.time, self.held_force, nothing, self.held.temperature, still=True)
        left = self.held.reading - state.bias - effect_readings(self.sensor, state.terms, motion, state.K)
        left -= self.held.creep @ state.K.T
        return float(np.sqrt(np.mean(np.sum((left @ state.matrix.T) ** 2, axis=1))))

    def with_excess(self, variance: Values) -> GyroscopeModel:
        """Return the model with an additional independent error of each move; ``variance``: (k,), deg^2."""
        out = copy(self)
        out.excess = variance
        return out

    def without(self, held: Mask) -> GyroscopeModel:
        """Return the model with the rests ``held``, and the moves that end at them, held out."""
        out = self.every.held_out.copy()
        out[~self.every.held_out] = held
        moves = None if self.moves is None else self.moves.select(~out[self.moves.after])
        return GyroscopeModel(replace(self.every, held_out=out), moves, **self.known)

    def direction_errors(self, state: State) -> tuple[Values, Values]:
        """Return the angle of each move between integrated and measured gravity, and its mean by noise alone, deg.

        The noise is white noise of both sensors and the scatter of the accelerometer's rests; both are (k,) arrays.
        """
        assert self.moves is not None  # noqa: S101
        A = self._turned(state)[2]
        predicted = np.einsum("kij,kj->ki", A[:, 0], self.before)
        across = np.linalg.norm(np.cross(predicted, self.after), axis=1)
        error = np.degrees(np.arctan2(across, np.einsum("ki,ki->k", predicted, self.after)))
        own = self._of_moves(state).error.reshape(-1, 2)
        return error, np.sqrt(0.25 * np.pi * np.sum(own**2, axis=1))

    def largest_direction_error(
        self, state: State, covariance: Values, freedom: Values, scatter: Mapping[str, Any], ratio: float
    ) -> float:
        """Return the bound that the rms of ``direction_errors`` exceeds with a probability of 0.5 %, deg; simulated.

        Errors of the accelerometer's calibration are drawn both for the directions and in the covariance, as if these
        were independent; so the bound is too large rather than too small.

        ``covariance``: (p, p), of bias and matrix first. ``freedom``: (p,), degrees of freedom. ``scatter``: of moves
        and of directions over the noise, as the fit found it. ``ratio``: of the bias wander to the white noise.
        """
        block = self._of_moves(state)
        n = len(block.residual)
        S = (1.0 + float(scatter.get("scatter_of_moves") or 0.0) ** 2) * np.eye(n) + np.asarray(block.common)
        S = S + float(scatter.get("scatter_of_directions") or 0.0) ** 2 * np.asarray(block.direction)
        held = np.asarray(block.bias)
        S = S + ratio**2 * np.einsum("cnk,cmk->nm", held, held)
        rng = np.random.default_rng(0)
        drawn = rng.standard_normal((DRAWS, n)) @ np.linalg.cholesky(S).T  # continuous in S, as eigenvectors are not
        errors = draw_normal(rng, covariance[:12, :12], DRAWS)
        for own in (slice(0, 3), slice(3, 12)):  # the wander makes those of the bias fewer
            few = min(float(freedom[own].min()), MANY)
            errors[:, own] *= np.sqrt(few / rng.chisquare(few, (DRAWS, 1)))
        drawn += errors @ block.base.T
        rms = np.sqrt(2.0 * np.mean((drawn * block.error) ** 2, axis=1))
        return float(np.quantile(rms, 1.0 - TAIL))

    def _at_rest(self, state: State) -> Block:
        rests, K = self.rests, state.K
        motion = motion_of(rests.time, self.force, np.zeros_like(self.force), rests.temperature, still=True)
        error = np.sqrt(rests.share[:, None]) * self.white
        left = rests.reading - state.bias - effect_readings(self.sensor, state.terms, motion, K) - rests.creep @ K.T
        m = len(rests.time)
        base = np.zeros((m, 3, 12))
        base[:, :, :3] = np.eye(3)
        bias = np.zeros((3, m, 3, m))
        for c in range(3):
            bias[c, np.arange(m), c, np.arange(m)] = self.white[c] / error[:, c]

        def columns(term: Term) -> Values:
            Z = term.effect.columns(self.sensor, motion, K, term.values) / error[:, :, None]
            return np.asarray(Z.reshape(3 * m, -1))

        return Block(
            (left / error).ravel(),
            (base / error[:, :, None]).reshape(3 * m, 12),
            columns,
            error.ravel(),
            bias.reshape(3, 3 * m, m),
            (rests.start, rests.length, rests.recording),
            scattered=True,
            common=self._of_creep(K, error),
        )

    def _of_creep(self, K: Values, error: Values) -> Values | None:
        """Return the covariance of the rests' equations by the uncertainty of their creep: (3 m, 3 m) array."""
        across, about = self.rests.creep_error, self.rests.creep_about
        if not about.any():
            return None
        u = self.force / np.linalg.norm(self.force, axis=1, keepdims=True)
        upward = u[:, :, None] * u[:, None, :]
        rate = across[:, None, None] ** 2 * (np.eye(3) - upward) + about[:, None, None] ** 2 * upward
        own = K @ rate @ K.T / error[:, :, None] / error[:, None, :]
        m = len(own)
        out = np.zeros((m, 3, m, 3))
        out[np.arange(m), :, np.arange(m)] = own
        return out.reshape(3 * m, 3 * m)

    def _of_moves(self, state: State) -> Block:
        moves = self.moves
        assert moves is not None  # noqa: S101
        motion, v, A = self._turned(state)
        predicted = np.einsum("kij,kj->ki", A[:, 0], self.before)
        E = tangents(self.after)
        G = (E @ skew(predicted))[:, None] @ A
        P = moves.weight[:, :, None, None] * G  # of a rate at a sample, deg per deg/s
        PM = P @ state.matrix
        directions = self._directions(E, A[:, 0])
        untold = np.einsum("ksij,ksj->ksi", G @ state.matrix, moves.doubt)
        own = np.einsum("ksij,j,kslj->kil", PM, self.white**2, PM) + np.einsum("ksi,ksj->kij", untold, untold)
        means = np.einsum("kimc,mcd->kimd", directions, self.spread)
        ends = np.einsum("kimc,mcd->kimd", directions, self.ends)
        variance = own + np.einsum("kimd,klmd->kil", means, means) + np.einsum("kimd,klmd->kil", ends, ends)
        variance += self.excess[:, None, None] * np.eye(2)
        W = np.asarray(np.linalg.solve(np.linalg.cholesky(variance), np.eye(2)), np.float64)
        base = np.concatenate([-PM.sum(axis=1), np.einsum("ksei,ksj->keij", P, v).reshape(moves.count, 2, 9)], axis=2)
        n = 2 * moves.count
        bias = np.zeros((3, moves.count, 2, moves.count))
        held = -W @ PM.sum(axis=1) * self.white
        bias[:, np.arange(moves.count), :, np.arange(moves.count)] = held.transpose(0, 2, 1)

        def columns(term: Term) -> Values:
            K = state.K
            Z = term.effect.columns(self.sensor, motion, K, term.values).reshape(*moves.weight.shape, 3, -1)
            return np.asarray((W @ -np.einsum("ksej,ksjp->kep", PM, Z)).reshape(n, -1))

        apart = np.degrees(np.einsum("kej,kj->ke", E, self.after - predicted))
        error = np.sqrt(np.einsum("kii->ki", variance)).ravel()
        shared = np.einsum("kij,kjmc,mcp->kip", W, directions, self.shared).reshape(n, -1)
        leaning = np.einsum("kij,kjmc,mcd->kimd", W, directions, self.across).reshape(n, -1)
        return Block(
            np.einsum("kij,kj->ki", W, apart).ravel() - shared @ self.known["gravity"].moved,
            (W @ base).reshape(n, 12),
            columns,
            error,
            bias.reshape(3, n, moves.count),
            (moves.time[:, 0], moves.time[:, -1] - moves.time[:, 0], self.every.recording[moves.after]),
            scattered=True,
            common=self._common(W, directions) + shared @ shared.T,
            direction=float(np.median(error)) ** 2 * leaning @ leaning.T,  # errors as large as a typical white one
            shared=shared,
        )

    def _directions(self, E: Values, A: Values) -> Values:
        """Return the derivative of each move's equations with respect to each rest's direction: (k, 2, m, 3) array."""
        assert self.moves is not None  # noqa: S101
        out = np.zeros((self.moves.count, 2, len(self.every.time), 3))
        rows = np.arange(self.moves.count)
        out[rows, :, self.moves.after] = E
        out[rows, :, self.moves.before] = -E @ A
        return out

    def _common(self, W: Values, directions: Values) -> Values:
        """Return the covariance of the moves' equations by errors of the rests' means: (2 k, 2 k) array."""
        n = 2 * len(W)
        directions = np.einsum("kij,kjmc->kimc", W, directions)
        means = np.einsum("kimc,mcd->kimd", directions, self.spread).reshape(n, -1)
        apart = np.kron(np.eye(len(W)), np.ones((2, 2))) == 0.0
        return np.where(apart, means @ means.T, 0.0)

    def accelerometer_errors(self, found: Fit) -> Values:
        """Return the estimate of the accelerometer's errors of bias and matrix from the moves: (12,) array."""
        equations = self.equations(found.state)
        shared = np.zeros((len(equations.residual), 12))
        shared[self.of_moves] = self._of_moves(found.state).shared
        white, _ = equations.whitened(found.noise, np.column_stack([shared, equations.residual]))
        return np.asarray(-self.known["gravity"].root @ (white[:, :12].T @ white[:, 12]))

    def _turned(self, state: State) -> tuple[Motion, Values, Values]:
        """Return the motion of all samples of the moves, ``v = y - b - z`` and A."""
        moves, K = self.moves, state.K
        assert moves is not None  # noqa: S101
        plain = moves.reading - state.bias
        rate, A = self._integrated(plain, state)
        v = plain
        for _ in range(ROUNDS if state.terms else 0):
            v = plain - effect_readings(self.sensor, state.terms, self._motion(rate, A), K).reshape(plain.shape)
            before = rate
            rate, A = self._integrated(v, state)
            if np.abs(rate - before).max() < SETTLED_DPS:
                break
        return self._motion(rate, A), v, A

    def _integrated(self, v: Values, state: State) -> tuple[Values, Values]:
        assert self.moves is not None  # noqa: S101
        rate = v @ state.matrix.T
        return rate, to_the_end(rate, self.moves.time)

    def _motion(self, rate: Values, A: Values) -> Motion:
        assert self.moves is not None  # noqa: S101
        end = np.einsum("kij,kj->ki", A[:, 0], self.before)
        force = self.gravity * np.einsum("ksij,ki->ksj", A, end)
        shape = (-1, 3)
        warmth = self.moves.temperature.ravel()
        return motion_of(self.moves.time.ravel(), force.reshape(shape), rate.reshape(shape), warmth, still=False)


def model_of(
    recordings: Sequence[Recording],
    calibration: SensorCalibration | None,
    noise: Noise | None,
    settings: Mapping[str, Any],
    accelerometer: SensorCalibration | None = None,
    *,
    moved: Values | None = None,
) -> GyroscopeModel | None:
    """Return the model of the recordings' rests and moves, or None if there is no rest.

    ``calibration``: of the gyroscope; its outlying moves are not used. ``settings``: sections ``table`` and
    ``procedure``. ``accelerometer``: without it, the accelerometer is calibrated here, which raises
    ``CannotCalibrateError`` if it fails. ``moved``: (12,), as of ``gravity.observed_rests``; without it, as
    ``calibration`` states.
    """
    if accelerometer is None:
        from pipeline.estimation.accelerometer import nonlinear_least_squares  # noqa: PLC0415  (needs this package)

        try:
            accelerometer = nonlinear_least_squares.fit(recordings, None, settings)
        except NotObservableError as lack:
            raise CannotCalibrateError(
                f"the gyroscope by hand needs the direction of gravity by a calibrated accelerometer: {lack.message}"
            ) from lack
    told = [stage.details for stage in calibration.stages] if calibration else []
    if moved is None:
        moved = next((np.array(d[MOVED]) for d in told if MOVED in d), None)
    observed = observed_rests(recordings, accelerometer, settings, moved=moved)
    if observed is None:
        return None
    rests, gravity = observed
    moves, turns, stated = moves_of(recordings, rests), None, settings["procedure"].get("turns")
    if stated:
        turns, every = turns_of(recordings, rests, accelerometer, stated)
        require_turns(turns, every, stated)
    if moves is not None and calibration is not None:
        off = {(move["recording"], float(move["time_s"])) for d in told for move in d.get("moves_outlying", ())}
        names = [recordings[int(i)].name for i in rests.recording[moves.after]]
        keys = zip(names, moves.time[:, 0].tolist(), strict=True)
        moves = moves.select(np.array([key not in off for key in keys]))
    return GyroscopeModel(rests, moves, gravity, noise, turns=turns)
