"""Bias and full matrix of the accelerometer from rests on stated faces, after the nine parameters of gravity's length.

The equations are those of ``accelerometer`` and of ``faces_and_turns``. The matrix refers to the case.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.estimation.least_squares import certified
from pipeline.estimation.multi_position.accelerometer import model_of
from pipeline.estimation.multi_position.faces_and_turns import DEPARTS, FACES, faces_of
from pipeline.estimation.multi_position.fit import fit
from pipeline.estimation.multi_position.likelihood import prior_hypotheses
from pipeline.estimation.multi_position.model import State
from pipeline.estimation.multi_position.rests import rests_of
from pipeline.estimation.multi_position.result import with_budget
from pipeline.estimation.noise import noise_of, prior_of
from pipeline.records import AXES, StageResult

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.records import Recording, SensorCalibration

NAME = "faces"


def require_faces(recordings: Sequence[Recording], settings: Mapping[str, Any]) -> None:
    """Raise ``NotObservableError`` that names the faces without a rest, by the readings as they are."""
    rests = rests_of("accelerometer", recordings, settings)
    if rests is not None:
        used = rests.select(~rests.held_out)
        faces_of(used, used.reading, settings)


def fit_faces(
    before: SensorCalibration, recordings: Sequence[Recording], settings: Mapping[str, Any]
) -> SensorCalibration:
    """Return the calibration of rests and their faces; ``before`` is that of the rests alone.

    Raises ``NotObservableError`` if there is no rest on a face.
    """
    model = model_of(recordings, before, noise_of("accelerometer", recordings, settings), settings)
    assert model is not None  # noqa: S101
    assert model.faces is not None  # noqa: S101
    prior = prior_of("accelerometer", recordings, settings)
    noises = prior_hypotheses(prior, float(np.mean(model.white)), model.kinds)
    found = fit(model, State(before.bias, before.matrix), noises, {})
    names = [f"bias_{a}" for a in AXES] + [f"matrix_{a}{b}" for a in AXES for b in AXES]
    values = np.concatenate([found.state.bias, found.state.matrix.ravel()])
    parameters = {
        name: {"value": float(v), "unit": "g" if i < 3 else "1", "standard_uncertainty": float(u)}
        for i, (name, v, u) in enumerate(zip(names, values, np.sqrt(np.diag(found.covariance)), strict=True))
    }
    force, _ = model.specific_force(found.state, model.rests)
    off = np.degrees(np.einsum("rmc,mc->r", model.faces.weights(), force) / model.gravity).reshape(-1, 2)
    departs = zip(FACES, np.linalg.norm(off, axis=1), strict=True)
    accuracy = float(settings["procedure"]["faces"]["accuracy_deg"])
    details = {
        "departures": [
            f"face {name} is {angle:.1f} deg off what the others say, {angle / accuracy:.1f} times "
            "procedure.faces.accuracy_deg"
            for name, angle in departs
            if angle > DEPARTS * accuracy
        ],
        "rests_on_faces": {name: int(np.count_nonzero(model.faces.face == i)) for i, name in enumerate(FACES)},
        "face_off_deg": dict(zip(FACES, np.linalg.norm(off, axis=1).tolist(), strict=True)),
        "scatter_of_rests": found.noise.scatter[0],
        "condition": found.condition,
        "degrees_of_freedom": float(found.degrees_of_freedom.min()),
    }
    at_rest = slice(0, model.rests_equations)
    rms = float(np.sqrt(np.mean((found.residual[at_rest] * found.error[at_rest]) ** 2)))
    calibration = replace(
        before,
        bias=found.state.bias,
        matrix=found.state.matrix,
        stages=(*before.stages, StageResult(NAME, parameters, rms, None, details)),
        converged=found.converged,
        convergence=certified(found.cosine, found.condition, found.rank, len(found.covariance)),
    )
    return with_budget(calibration, found.covariance, found.degrees_of_freedom, model, found, settings)
