"""Equations of the gyroscope: zero rate at rest, and moves whose integrated rate rotates gravity to its new direction.

    at rest:  r = (y - b - z - K w) / s_e,     dr/db = -1/s_e,   dr/dp = -dz/dp / s_e
    a move:   r = W E^T (u_after - A_0 u_before),   omega = M (y - b - z)

where

    y, b, M : reading and bias, deg/s, and matrix
    z, p    : effects and their parameters; in a move at the specific force of the rest, rotated along the move
    w       : creep rate of the unit in a rest, across gravity by the accelerometer (K = M^-1); the rate about gravity
              is unknown and of the same size (``pipeline.physics.signal.quiet_motion.posterior_creep_rates``)
    u       : direction of gravity by the calibrated accelerometer (``gravity``); A_0 as in ``moves``
    E       : two directions across u_after; W whitens the integrated noise of the gyroscope, the uncertainty of the
              rate between samples, and the noise of the accelerometer

Two moves share the error of the direction at the rest between them, and all moves share the errors of the
accelerometer's calibration: ``du = (1 - u u^T) (M_a dy - M_a db_a + dM_a v_a) / G``. The frame is that of the
accelerometer's matrix. One move does not show a turn about the vertical; others do, as the vertical has another
direction in the body. If the procedure states the total angle of turns, their equations are added
(``faces_and_turns``).

Source: Tedaldi, Pretto & Menegatti, ICRA 2014, eq. 12.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import scipy

from pipeline.core.records import BASE, BASE_COUNT, BASE_NAMES, BIAS, MATRIX
from pipeline.estimation.gauss_markov import block_covariance
from pipeline.estimation.multi_position.accelerometer import SMALLEST_NOISE, white_of
from pipeline.estimation.multi_position.faces_and_turns import TurnsByHand, turns_of
from pipeline.estimation.multi_position.model import (
    EquationBlock,
    Equations,
    State,
    effect_readings,
    limit_block,
    motion_at_rests,
    motion_of,
    stacked,
)
from pipeline.estimation.multi_position.moves import (
    GravityAtRests,
    Moves,
    moves_of,
    observed_rests,
    tangents,
    to_the_end,
)
from pipeline.physics.kinematics import skew

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.core.records import Mask, Motion, Noise, Recording, SensorCalibration, Values
    from pipeline.core.settings import Procedure
    from pipeline.estimation.design import Terms
    from pipeline.estimation.multi_position.fit import FitByHand
    from pipeline.estimation.rest_means import Rests

MIN_MOVES = 6  # two equations each, for the nine of the matrix
RATE_ITERATIONS = 6  # of effects that depend on the rate
SETTLED_DPS = 1e-6  # change of the rate that ends these rounds: 1e-5 deg in 10 s, 2e-3 of the noise of a move


@dataclass(eq=False)
class GyroscopeModel:
    """Equations of the gyroscope's rests and moves."""

    sensor: ClassVar[str] = "gyroscope"
    every: Rests  # all, also held-out ones, at which a move may begin
    moves: Moves | None  # None also if they are fewer than ``fewest``
    at_rests: GravityAtRests  # at each of ``every``, by the accelerometer
    noise: Noise | None
    fewest: int = MIN_MOVES  # smallest number of moves that are used
    turns: TurnsByHand | None = None  # of a stated total angle
    # elements of the matrix with a pseudo-observation, each with its u
    known_by_limit: Mapping[str, float] = field(default_factory=dict)
    between: float = 0.0  # see ``model``
    frame: float = 0.0  # rad; standard uncertainty of each angle between the frame of the fit and the case

    def __post_init__(self) -> None:
        rests, gravity, turns = self.every, self.at_rests, self.turns
        self.white = np.maximum(white_of(rests, self.noise), SMALLEST_NOISE)
        self.rests, self.force = rests.select(~rests.held_out), gravity.force[~rests.held_out]
        self.moves = self.moves if self.moves is not None and self.moves.count >= self.fewest else None
        self.kinds = 1 if self.moves is None else 2
        free = self.moves is not None or turns is not None or bool(self.known_by_limit)
        self.directions = np.eye(BASE_COUNT)[:, BASE if free else BIAS]
        self.rests_equations = 3 * len(self.rests.time)
        self.of_moves = slice(self.rests_equations, self.rests_equations + (2 * self.moves.count if self.moves else 0))
        last = self.of_moves.stop
        self.of_turns = slice(last, last + (len(turns.error) if turns else 0))
        self.gravity = float(np.median(np.linalg.norm(gravity.force, axis=1)))
        if self.moves is not None:
            self.before, self.after = gravity.at_end[self.moves.before], gravity.at_start[self.moves.after]
            self.excess = np.zeros(self.moves.count)  # deg^2, variance of a further independent error of each move

    def equations(self, state: State, candidates: Terms = ()) -> Equations:
        """Return the linearised equations at given parameters."""
        blocks = [self._at_rest(state)]
        if self.moves is not None:
            blocks.append(self.equations_of_moves(state))
        if self.turns is not None:
            blocks.append(self.turns.equations(state, self.white))
        if self.known_by_limit:
            columns = np.eye(BASE_COUNT)[[BASE_NAMES.index(name) for name in self.known_by_limit]]
            by_frame = -self.frame * (skew(np.eye(3)).reshape(3, 9) @ columns[:, MATRIX].T).T  # by each of its angles
            limits = np.array(list(self.known_by_limit.values()))[:, None]
            of_limits = limit_block(self.known_by_limit, columns, state)
            blocks.append(replace(of_limits, frame=by_frame / limits if self.frame else None))
        return stacked(blocks, self, state, candidates)

    @property
    def temperature(self) -> Values:
        """Temperatures of the rests, degC."""
        return self.rests.temperature

    def samples(self) -> float:
        """Return the number of samples in the equations."""
        return float(self.rests.count.sum()) + (0.0 if self.moves is None else float(np.sum(self.moves.weight > 0)))

    def held_out_squares(self, state: State) -> Values:
        """Return the squared rate at each held-out rest, (deg/s)^2: (m,) array."""
        held = self.every.held_out
        if not held.any():
            return np.zeros(0)
        error, _ = self._rate_at_rest(self.every.select(held), self.at_rests.force[held], state)
        return np.asarray(np.sum((error @ state.matrix.T) ** 2, axis=1))

    def without(self, held: Mask) -> GyroscopeModel:
        """Return the model with the rests ``held``, and the moves that end at them, held out.

        Its kinds of scatter stay those of this model, also if too few moves are left, as hypotheses state each kind.
        """
        out = self.every.held_out.copy()
        out[~self.every.held_out] = held
        moves = None if self.moves is None else self.moves.select(~out[self.moves.after])
        part = replace(self, every=replace(self.every, held_out=out), moves=moves)
        part.kinds = self.kinds
        return part

    def direction_errors(self, state: State) -> tuple[Values, Values]:
        """Return the angle of each move between integrated and measured gravity, and its mean by noise alone, deg.

        The noise is white noise of both sensors and the scatter of the accelerometer's rests; both are (k,) arrays.
        """
        A = self._turned(state)[2]
        predicted = np.einsum("kij,kj->ki", A[:, 0], self.before)
        across = np.linalg.norm(np.cross(predicted, self.after), axis=1)
        error = np.degrees(np.arctan2(across, np.einsum("ki,ki->k", predicted, self.after)))
        noise = self.equations_of_moves(state).error.reshape(-1, 2)
        return error, np.sqrt(0.25 * np.pi * np.sum(noise**2, axis=1))

    def _rate_at_rest(self, rests: Rests, force: Values, state: State) -> tuple[Values, Motion]:
        """Return the readings at rests minus those that the model predicts, (m, 3), and the motion."""
        motion = motion_at_rests(rests, force)
        predicted = state.bias + effect_readings(self.sensor, state.terms, motion, state.K) + rests.creep @ state.K.T
        return rests.reading - predicted, motion

    def _at_rest(self, state: State) -> EquationBlock:
        rests, K = self.rests, state.K
        residual, motion = self._rate_at_rest(rests, self.force, state)
        error = np.sqrt(rests.variance(self.white))
        m = len(rests.time)
        base = np.zeros((m, 3, BASE_COUNT))
        base[:, :, BIAS] = np.eye(3) / error[:, :, None]
        bias = np.zeros((3, m, 3, m))
        for c in range(3):
            bias[c, np.arange(m), c, np.arange(m)] = self.white[c] / error[:, c]
        return EquationBlock(
            (residual / error).ravel(),
            base.reshape(3 * m, BASE_COUNT),
            lambda term: (term.columns(self.sensor, motion, K) / error[:, :, None]).reshape(3 * m, -1),
            error.ravel(),
            bias.reshape(3, 3 * m, m),
            (rests.start, rests.length, rests.recording),
            scattered=True,
            common=self._of_rests(K, error),
        )

    def _of_rests(self, K: Values, error: Values) -> Values | None:
        """Return the covariance of the rests' equations by creep, and by rounding that all rests share: (3 m, 3 m)."""
        across, about, r = self.rests.creep_error, self.rests.creep_about, self.rests.rounding
        if not about.any() and not r.any():
            return None
        rounding = np.einsum("ic,jd,cd->icjd", r / error, r / error, np.eye(3)).reshape(error.size, -1)
        length = np.linalg.norm(self.force, axis=1, keepdims=True)
        u = self.force / np.where(length > 0.0, length, 1.0)  # zero without an accelerometer, which alone shows creep
        upward = u[:, :, None] * u[:, None, :]
        rate = across[:, None, None] ** 2 * (np.eye(3) - upward) + about[:, None, None] ** 2 * upward
        creep = scipy.linalg.block_diag(*(K @ rate @ K.T / error[:, :, None] / error[:, None, :]))
        return np.asarray(creep + rounding)

    def equations_of_moves(self, state: State) -> EquationBlock:
        """Return the equations of the moves."""
        moves, gravity = self.moves, self.at_rests
        assert moves is not None  # noqa: S101
        k, n = np.arange(moves.count), 2 * moves.count
        motion, v, A = self._turned(state)
        predicted = np.einsum("kij,kj->ki", A[:, 0], self.before)
        E = tangents(self.after)
        G = (E @ skew(predicted)) @ A.transpose(0, 2, 1, 3).reshape(moves.count, 3, -1)  # (k, 2, 3 s)
        P = (moves.weight[:, None, :, None] * G.reshape(moves.count, 2, -1, 3)).reshape(-1, 3)  # deg per deg/s
        PM = (P @ state.matrix).reshape(moves.count, 2, -1)
        noise = PM * np.tile(self.white, moves.weight.shape[1])
        D = np.zeros((moves.count, 2, len(self.every.time), 3))  # deg per g of each rest's force
        u = gravity.force / np.linalg.norm(gravity.force, axis=1, keepdims=True)
        across = np.degrees(np.eye(3) - u[:, :, None] * u[:, None, :]) / self.gravity
        D[k, :, moves.after] = E @ across[moves.after]
        D[k, :, moves.before] = -E @ A[:, 0] @ across[moves.before]
        variance = noise @ noise.transpose(0, 2, 1)
        if moves.doubt.any():
            doubt = np.einsum("kisj,ksj->kis", G.reshape(moves.count, 2, -1, 3), moves.doubt @ state.matrix.T)
            variance += doubt @ doubt.transpose(0, 2, 1)
        variance += np.einsum("kimd,klmd,m->kil", D, D, gravity.spread**2 + gravity.ends**2)
        variance += self.excess[:, None, None] * np.eye(2)
        W = np.asarray(np.linalg.solve(np.linalg.cholesky(variance), np.eye(2)), np.float64)
        error = np.sqrt(np.einsum("kii->ki", variance)).ravel()
        turned = P.reshape(moves.count, 2, -1, 3).transpose(0, 1, 3, 2).reshape(moves.count, 6, -1) @ v
        by_bias = -PM.reshape(moves.count, 2, -1, 3).sum(axis=2)
        base = np.concatenate([by_bias, turned.reshape(moves.count, 2, 9)], axis=2)
        bias = np.zeros((3, moves.count, 2, moves.count))
        bias[:, k, :, k] = (W @ (by_bias * self.white)).transpose(0, 2, 1)
        rows, K = -W @ PM, state.K
        apart = np.degrees(np.einsum("kej,kj->ke", E, self.after - predicted))
        WD = np.einsum("kij,kjmc->kimc", W, D).reshape(n, -1, 3)
        shared = np.einsum("nmc,mcp->np", WD, gravity.shared)
        means = (WD * gravity.spread[:, None]).reshape(n, -1)
        other_move = np.kron(np.eye(moves.count), np.ones((2, 2))) == 0.0
        directions = np.median(error) * self.gravity * np.radians(WD).reshape(n, -1)  # by errors of a typical white one
        return EquationBlock(
            np.einsum("kij,kj->ki", W, apart).ravel() - shared @ gravity.moved,
            (W @ base).reshape(n, BASE_COUNT),
            lambda term: (rows @ term.columns(self.sensor, motion, K).reshape(*rows.shape[::2], -1)).reshape(n, -1),
            error,
            bias.reshape(3, n, moves.count),
            (moves.time[:, 0], moves.time[:, -1] - moves.time[:, 0], self.every.recording[moves.after]),
            scattered=True,
            common=np.where(other_move, means @ means.T, 0.0) + shared @ shared.T,
            direction=directions @ directions.T,
            shared=shared,
            force=WD,
        )

    def accelerometer_errors(self, fitted: FitByHand) -> Values:
        """Return the estimate of the accelerometer's errors of bias and matrix from the moves: (12,) array."""
        equations = fitted.equations
        shared = np.zeros((len(equations.residual), BASE_COUNT))
        shared[self.of_moves] = self.equations_of_moves(fitted.state).shared
        white, _ = equations.whitened(fitted.noise, np.column_stack([shared, equations.residual]))
        return np.asarray(-self.at_rests.root @ (white[:, :-1].T @ white[:, -1]))

    def _turned(self, state: State) -> tuple[Motion, Values, Values]:
        """Return the motion of all samples of the moves, ``v = y - b - z`` and A."""
        moves, K = self.moves, state.K
        assert moves is not None  # noqa: S101

        def motion_at(rate: Values, force: Values) -> Motion:
            return motion_of(moves, force.reshape(-1, 3), rate.reshape(-1, 3), still=False)

        def integrated(rate: Values) -> tuple[Values, Values]:
            A = to_the_end(rate, moves.time)
            end = np.einsum("kij,kj->ki", A[:, 0], self.before)
            return A, self.gravity * (end[:, None, None, :] @ A)[:, :, 0]

        plain = v = moves.reading - state.bias
        rate, force = v @ state.matrix.T, np.zeros_like(v)
        turns_force = any("specific_force" in t.effect.fields(self.sensor, t.values) for t in state.terms)
        for _ in range(RATE_ITERATIONS if state.terms else 0):
            if turns_force:
                _, force = integrated(rate)
            added = effect_readings(self.sensor, state.terms, motion_at(rate, force), K)
            v, before = plain - added.reshape(plain.shape), rate
            rate = v @ state.matrix.T
            if np.abs(rate - before).max() < SETTLED_DPS:
                break
        A, force = integrated(rate)
        return motion_at(rate, force), v, A


def model_of(
    recordings: Sequence[Recording],
    calibration: SensorCalibration | None,
    noise: Noise | None,
    procedure: Procedure,
    accelerometer: SensorCalibration | None,
    *,
    moved: Values | None = None,
    known_by_limit: Mapping[str, float] | None = None,
    frame_deg: float = 0.0,
) -> GyroscopeModel | None:
    """Return the model of the recordings' rests and moves, or None if there is no rest.

    ``calibration``: of the gyroscope; its outlying moves are not used. ``moved``: (12,), see ``moves.observed_rests``;
    by default that of ``calibration``, as is ``known_by_limit``. ``frame_deg``: see ``faces_and_turns.turns_of``.
    """
    details = [stage.details for stage in calibration.stages] if calibration else []
    if moved is None:
        moved = next((np.array(d.accelerometer_moved) for d in details if d.accelerometer_moved is not None), None)
    if known_by_limit is None:
        known_by_limit = next((d.known_by_limit for d in details if d.known_by_limit is not None), {})
    observed = observed_rests(recordings, accelerometer, procedure, moved=moved)
    if observed is None:
        return None
    rests, gravity = observed
    moves = None if accelerometer is None else moves_of(recordings, rests)
    turns = turns_of(recordings, rests, accelerometer, procedure, frame_deg=frame_deg)
    if moves is not None and calibration is not None:
        outlying = {(move.recording, move.time_s) for d in details for move in d.moves_outlying or ()}
        names = [recordings[int(i)].name for i in rests.recording[moves.after]]
        keys = zip(names, moves.time[:, 0].tolist(), strict=True)
        moves = moves.select(np.array([key not in outlying for key in keys]))
    sheet = procedure.sheet is not None
    between, frame = between_recordings(rests, turns, noise) if sheet else 0.0, float(np.radians(frame_deg))
    fewest = 1 if sheet else MIN_MOVES
    return GyroscopeModel(rests, moves, gravity, noise, fewest, turns, known_by_limit, between, frame)


def between_recordings(rests: Rests, turns: TurnsByHand | None, noise: Noise | None) -> float:
    """Return the standard deviation of the bias from one recording to the next, over white noise.

    By the scatter of the means of the rests of each recording; with rests in one recording only, and turns in others,
    it is the bias wander.
    """
    white = np.maximum(white_of(rests, noise), SMALLEST_NOISE)
    names = np.unique(rests.recording)
    if len(names) > 1:
        own = [rests.recording == name for name in names]
        W = np.array([k * rests.count / rests.count[k].sum() for k in own])
        means = W @ rests.reading / white
        within = np.mean([np.average(rests.share[k], weights=rests.count[k]) / np.count_nonzero(k) for k in own])
        if noise is not None:  # the hypotheses hold the wander of these means
            together = np.sum(W @ block_covariance(rests.start, rests.length, noise.correlation_time) * W, axis=1)
            within += np.mean(together) * np.mean((noise.wander / white) ** 2)
        return float(np.sqrt(max(np.mean(np.var(means, axis=0, ddof=1)) - within, 0.0)))
    elsewhere = turns is not None and np.any(turns.recording != names[0])
    return float(np.sqrt(np.mean((noise.wander / white) ** 2))) if elsewhere and noise is not None else 0.0
