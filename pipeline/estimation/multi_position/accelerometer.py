"""Equations of the accelerometer at rest: its specific force has the magnitude of gravity.

    r = (G' - |f|) / s_e,   f = M v,   v = y - b - z(f),   G'^2 = G^2 + 2 s^2 w
    d|f|/db = -n^T M,   d|f|/dM_ij = n_i v_j,   d|f|/dp = -n^T M dz/dp,   n = f / |f|

where

    y   : (3,) mean reading of a rest, g; w s^2 its variance, s^2 that of a sample
    b, M: bias, g, and matrix ``M = Q L``: |f| determines the lower triangular L, but not the rotation Q, which is fixed
    z   : effects, at the force of the magnitude of gravity; p their parameters
    s_e : standard deviation of |f|: ``s_e^2 = sum_c (M^T n)_c^2 (w s_c^2 + v + r_c^2)``, r the rounding error of
          coarse readings, v the variance of a mean that was recorded as such, whose w is 0

If the procedure states faces, their equations are added (``faces_and_turns``), and the full matrix is fitted. Otherwise
a misalignment that the rests do not determine is known by the sensor file's limit c of the cross-axis sensitivity:

    L_ij = 0 +- u,   u = sqrt(2 / 3) c

because L_ij is the angle between two axes, the sum of their two cross-axis sensitivities, both uniform within c. With a
sheet of recordings the same holds for bias and scale factors, uniform within their limits.

Equations of a soak: the attitude is fixed while the temperature changes. Its mean reading is a rest of the fit, with
the mean of the effects z over its parts, so that an error of one part, as by hysteresis, does not move all. The
readings y_k of its K parts differ by effects alone:

    y_k - c(y) = z(T_k) - c(z),   c(x) = (sqrt(K) mean(x) - x_0) / (sqrt(K) - 1),   k = 1 ... K - 1

with the effects at the specific force of the attitude. By c these are rows of a Householder reflection: errors of the
parts that are equal and independent make errors of the equations that are so too, and independent of the mean's. In
one attitude a change of the bias along gravity is not distinguished from one of the scale factor; in several it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import scipy

from pipeline.core.records import BASE_COUNT, Mask, Motion, Noise, Recording, SensorCalibration, Values
from pipeline.core.settings import DataSheet, Settings
from pipeline.estimation.design import EffectColumns, Terms
from pipeline.estimation.multi_position.faces_and_turns import Faces, faces_of
from pipeline.estimation.multi_position.model import (
    EquationBlock,
    Equations,
    State,
    effect_readings,
    limit_block,
    motion_at_rests,
    stacked,
)
from pipeline.estimation.rest_means import HELD_OUT, Rests, rests_of

FORCE_ITERATIONS = 12  # of effects that depend on the force
SETTLED_FORCE_G = 1e-12  # g
SMALLEST_NOISE = 1e-9  # g
SAME_ATTITUDE = 1e-3  # rad, and from a half turn: the axis of a move is rounding and noise
# Of b and the lower triangle of L.
PARAMETERS = (
    "bias_x", "bias_y", "bias_z", "scale_factor_x", "misalignment_yx", "scale_factor_y", "misalignment_zx",
    "misalignment_zy", "scale_factor_z",
)  # fmt: skip


def parted(rests: Rests) -> tuple[Rests, Rests | None]:
    """Return the rests of the fit, a soak as the mean of its parts, and the parts of all soaks; None without one."""
    if not rests.soaked.any():
        return rests, None
    parts = rests.select(rests.soaked)
    _, first, of = np.unique(rests.recording[rests.soaked], return_index=True, return_inverse=True)
    kept, number = ~rests.soaked, np.flatnonzero(rests.soaked)[first]
    kept[number] = True
    own = (np.arange(len(first))[:, None] == of).astype(float)
    mean = own / own.sum(axis=1, keepdims=True)
    found = rests.select(kept)
    weights = dict.fromkeys(("reading", "time", "temperature", "temperature_rate"), mean)
    weights |= dict.fromkeys(("share", "own"), mean**2) | dict.fromkeys(("count", "scatter", "length"), own)
    columns = {name: getattr(found, name).copy() for name in weights}
    for name, column in columns.items():
        column[found.soaked] = weights[name] @ getattr(parts, name)
    return replace(found, **columns), parts


def contrasts(parts: Rests) -> Values:
    """Return the differences of the K parts of each soak from their c: (k - s, k) array of orthonormal rows."""
    blocks = []
    for size in np.unique(parts.recording, return_counts=True)[1].tolist():
        v = np.full(size, 1.0 / np.sqrt(size)) - np.eye(size)[0]
        blocks.append((np.eye(size) - 2.0 * np.outer(v, v) / max(float(v @ v), SMALLEST_NOISE))[1:])
    return np.asarray(scipy.linalg.block_diag(*blocks))


@dataclass(eq=False)
class AccelerometerModel:
    """Equations of the accelerometer's rests."""

    sensor: ClassVar[str] = "accelerometer"
    kinds: ClassVar[int] = 1
    between: ClassVar[float] = 0.0
    rests: Rests  # of the fit
    directions: Values  # (12, b), change of bias and matrix by each base parameter
    gravity: float  # g
    noise: Noise | None
    held: Rests | None = None  # held-out rests
    faces: Faces | None = None  # of ``rests``, if they are stated: the full matrix is then free
    # parameters with a pseudo-observation, each with its u
    known_by_limit: Mapping[str, float] = field(default_factory=dict)
    wander: bool = True  # whether the equations include the errors by a Gauss-Markov bias
    soaks: Rests | None = None  # parts of soaks
    after_moves: bool = False  # whether effects see the direction of the last move (``last_moves``)

    def __post_init__(self) -> None:
        rests, soaks = self.rests, self.soaks
        if self.faces is not None:
            self.directions, self.known_by_limit = np.eye(BASE_COUNT), {}
        self.white = np.maximum(white_of(rests, self.noise), SMALLEST_NOISE)
        self.rests_equations = len(rests.time)
        shares, stretches = np.eye(len(rests.time)), [rests]
        if soaks is not None:
            self.attitudes, _ = parted(soaks)
            own = rests.recording[:, None] == soaks.recording
            own = (own & rests.soaked[:, None]) / np.maximum(own.sum(axis=1, keepdims=True), 1)
            shares, stretches = np.hstack([shares[:, ~rests.soaked], own]), [rests.select(~rests.soaked), soaks]
        t = shares.shape[1] if self.wander else 0
        self.shares = shares[:, :t]  # (m, t), of each stretch of time in each rest
        start, length, recording = (
            np.concatenate([getattr(r, n) for r in stretches])[:t] for n in ("start", "length", "recording")
        )
        self.stretches = start, length, recording

    def equations(self, state: State, candidates: Terms = ()) -> Equations:
        """Return the linearised equations at given parameters."""
        rests, K = self.rests, state.K
        force, v = self.specific_force(state, rests)
        length = np.linalg.norm(force, axis=1)
        n = force / length[:, None]
        along = n @ state.matrix
        variance = rests.variance(self.white)
        error = np.sqrt(np.sum(along**2 * variance, axis=1))
        target = np.sqrt(self.gravity**2 + 2.0 * (rests.share * np.mean(self.white**2) + rests.own))
        after = last_moves(state, rests, n) if self.after_moves else None
        base = np.concatenate([-along, (n[:, :, None] * v[:, None, :]).reshape(-1, 9)], axis=1)

        def effect_columns(term: EffectColumns) -> Values:
            return self._at_rests(rests, self.gravity * n, lambda motion: term.columns(self.sensor, motion, K), after)

        of_rests = EquationBlock(
            (target - length) / error,
            base / error[:, None],
            lambda term: np.einsum("nc,ncp->np", -along, effect_columns(term)) / error[:, None],
            error,
            (along * self.white / error[:, None]).T[:, :, None] * self.shares,
            self.stretches,
            scattered=True,
            alike=self._alike(error) if rests.scatter_time else None,
        )
        if self.faces is None:
            columns = self.directions[:, [PARAMETERS.index(name) for name in self.known_by_limit]].T
            of_limits = limit_block(self.known_by_limit, columns, state, self.gravity)
            of_soaks = [] if self.soaks is None else [self._of_soaks(state, self.soaks)]
            return stacked([of_rests, *of_soaks, of_limits], self, state, candidates)
        W = self.faces.weights() / self.gravity
        WM = W @ state.matrix
        wide = np.sqrt(self.faces.error**2 + np.einsum("rmc,mc->r", WM**2, variance))
        by_matrix = np.einsum("rmi,mj->rij", W, v).reshape(-1, 9)
        of_faces = EquationBlock(
            -np.einsum("rmc,mc->r", W, force) / wide,
            np.concatenate([-WM.sum(axis=1), by_matrix], axis=1) / wide[:, None],
            lambda term: np.einsum("rmc,mcp->rp", -WM, effect_columns(term)) / wide[:, None],
            self.gravity * wide,
            np.einsum("rmc,c->crm", WM, self.white) / wide[:, None],
        )
        return stacked([of_rests, of_faces], self, state, candidates)

    def _alike(self, error: Values) -> Values:
        """Return the covariance of the scatter between the rests, (m, m), over their standard deviations (m,)."""
        rests, size = self.rests, np.median(error) / error
        apart = np.abs(rests.time[:, None] - rests.time) / rests.scatter_time
        same = (rests.recording[:, None] == rests.recording) & ~np.eye(len(size), dtype=bool)
        return np.asarray(np.where(same, np.exp(-apart) * np.outer(size, size), 0.0))

    def _at_rests(
        self, rests: Rests, force: Values, value: Callable[[Motion], Values], direction: Values | None = None
    ) -> Values:
        """Return values of the motion at rests with the specific force (m, 3), g; of a soak, their mean."""
        motion = motion_at_rests(rests, force)
        found = value(motion if direction is None else replace(motion, direction=direction))
        for row in np.flatnonzero(rests.soaked):
            parts = self.soaks and self.soaks.select(self.soaks.recording == rests.recording[row])
            if parts is not None and len(parts.time):
                found[row] = value(motion_at_rests(parts, np.tile(force[row], (len(parts.time), 1)))).mean(axis=0)
        return found

    def _of_soaks(self, state: State, soaks: Rests) -> EquationBlock:
        force, C = self.specific_force(state, self.attitudes)[0], contrasts(soaks)
        motion = motion_at_rests(soaks, force[np.searchsorted(self.attitudes.recording, soaks.recording)])
        every = np.sqrt(soaks.variance(self.white))
        error = every[np.flatnonzero(np.diff(soaks.recording, prepend=-1) == 0)]
        z = effect_readings(self.sensor, state.terms, motion, state.K)
        k, t = len(error), len(self.stretches[0])
        bias = np.zeros((3, k, 3, t))
        for c in range(3 if t else 0):
            bias[c, :, c, t - len(soaks.time) :] = C * self.white[c] / error[:, c, None]

        def columns(term: EffectColumns) -> Values:
            Z = term.columns(self.sensor, motion, state.K)
            return np.asarray((np.einsum("ij,jcp->icp", C, Z) / error[:, :, None]).reshape(3 * k, -1))

        residual, by_bias = (C @ (soaks.reading - z) / error).ravel(), bias.reshape(3, 3 * k, t)
        nothing = np.zeros((3 * k, BASE_COUNT))
        return EquationBlock(residual, nothing, columns, error.ravel(), by_bias, scattered=True)

    def specific_force(self, state: State, rests: Rests) -> tuple[Values, Values]:
        """Return the specific force of each rest, g, and v: (m, 3) arrays."""
        v, K = rests.reading - state.bias, state.K
        force = v @ state.matrix.T

        def added(motion: Motion) -> Values:
            return effect_readings(self.sensor, state.terms, motion, K)

        for _ in range(FORCE_ITERATIONS if state.terms else 0):
            size = np.linalg.norm(force, axis=1, keepdims=True)
            v = rests.reading - state.bias - self._at_rests(rests, self.gravity * force / size, added)
            before, force = force, v @ state.matrix.T
            if np.abs(force - before).max() < SETTLED_FORCE_G:
                break
        return force, v

    @property
    def temperature(self) -> Values:
        """Temperatures of all equations, degC."""
        parts = [self.rests, *([] if self.soaks is None else [self.soaks])]
        return np.concatenate([part.temperature for part in parts])

    def samples(self) -> float:
        """Return the number of samples in the equations."""
        return float(self.rests.count.sum())

    def held_out_squares(self, state: State) -> Values:
        """Return the squared error of |f| at each held-out rest, g^2: (m,) array."""
        if self.held is None or len(self.held.time) == 0:
            return np.zeros(0)
        force, _ = self.specific_force(state, self.held)
        return np.asarray((np.linalg.norm(force, axis=1) - self.gravity) ** 2)

    def without(self, held: Mask) -> AccelerometerModel:
        """Return the model with some of its rests held out."""
        faces = self.faces and self.faces.select(~held)
        return replace(self, rests=self.rests.select(~held), held=self.rests.select(held), faces=faces)


def last_moves(state: State, rests: Rests, up: Values) -> Values:
    """Return the axis of the shortest move to each rest: (m, 3) unit vectors, zeros where the rest before is unknown.

    A turn by a about e turns gravity in the body, ``up``, by -a: from u to v about ``e = v x u / |v x u|``.
    """
    axis = np.cross(up, (rests.before - state.bias) @ state.matrix.T)
    size = np.linalg.norm(axis, axis=1, keepdims=True)
    return np.where(size > SAME_ATTITUDE, axis / np.maximum(size, SAME_ATTITUDE), 0.0)


def white_of(rests: Rests, noise: Noise | None) -> Values:
    """Return the white noise of a raw sample: (3,) array."""
    if noise is not None and np.all(np.isfinite(noise.white)) and np.all(noise.white > 0):
        return noise.white
    return rests.white


def limits_of_parameters(data_sheet: DataSheet) -> dict[str, float]:
    """Return u of each of ``PARAMETERS`` by the sensor file's limits; ``data_sheet``: of the accelerometer."""
    uniform = {"bias": data_sheet.bias, "scale_factor": data_sheet.scale_factor}
    limits = {kind: float(limit / np.sqrt(3.0)) for kind, limit in uniform.items()}
    limits["misalignment"] = limit_of_misalignment(data_sheet)
    return {name: limits[name.rpartition("_")[0]] for name in PARAMETERS}


def limit_of_misalignment(data_sheet: DataSheet) -> float:
    """Return u of a misalignment by the sensor file's limit, rad; ``data_sheet``: of the accelerometer."""
    return float(np.sqrt(2.0 / 3.0)) * data_sheet.cross_axis


def _directions(calibration: SensorCalibration) -> Values:
    """Return the derivative of bias and matrix with respect to b and the lower triangle of L: (12, 9) array."""
    flipped, _ = np.linalg.qr(calibration.matrix[:, ::-1])
    Q = flipped[:, ::-1]
    Q = Q * np.sign(np.diag(Q.T @ calibration.matrix))
    Q = np.eye(3) if np.allclose(Q, np.eye(3), atol=1e-9) else Q
    lower = np.flatnonzero(np.tril(np.ones((3, 3))))
    return scipy.linalg.block_diag(np.eye(3), np.kron(Q, np.eye(3))[:, lower])


def model_of(
    recordings: Sequence[Recording], calibration: SensorCalibration, noise: Noise | None, settings: Settings
) -> AccelerometerModel | None:
    """Return the model of the recordings' rests, or None if there are none; ``calibration``: of the method."""
    rests = rests_of("accelerometer", recordings, settings.procedure, calibration)
    if rests is None:
        return None
    gravity = settings.table.gravity_g
    held = rests_of("accelerometer", recordings, settings.procedure, role=HELD_OUT) or rests.select(rests.held_out)
    used, soaks = parted(rests.select(~rests.held_out))
    faces = faces_of(used, (used.reading - calibration.bias) @ calibration.matrix.T, settings.procedure.faces)
    details = [stage.details for stage in calibration.stages]
    known = {name: u for detail in details for name, u in (detail.known_by_limit or {}).items()}
    for noise_of_means in (detail.noise_of_means for detail in details if detail.noise_of_means is not None):
        used = replace(used, own=np.full(len(used.time), noise_of_means**2))
    for detail in details:
        used = replace(used, scatter_time=detail.scatter_time_s or used.scatter_time)
    directions = _directions(calibration)
    return AccelerometerModel(used, directions, gravity, noise, held, faces, known, soaks=soaks)
