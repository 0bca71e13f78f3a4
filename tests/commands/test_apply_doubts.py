"""What `apply` says against a log, and where it writes; the logs are simulated with a known calibration."""

from __future__ import annotations

import json
import os
import re
import stat
from pathlib import Path

import numpy as np
import pytest

from pipeline.app.commands.apply import main
from pipeline.core.errors import InputError
from pipeline.core.records import SensorCalibration

NAMES = ["time_s", *(f"accel_{a}_g" for a in "xyz"), *(f"gyro_{a}_dps" for a in "xyz")]
A = (np.array([0.03, -0.02, 0.05]), np.diag([1.01, 0.99, 1.02]) + np.pi * 1e-3)
W = (np.array([1.0, -2.0, 0.5]), np.diag([1.01, 0.99, 1.0]) + np.pi * 2e-3)
RATE_HZ = 100.0


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    parts = {s: SensorCalibration(s, *v).to_json() for s, v in (("accelerometer", A), ("gyroscope", W))}
    file = tmp_path / "U1.json"
    head = {"schema_version": 1, "unit": "U1", "status": "ok", "error": None}
    file.write_text(json.dumps({**head, **parts}), encoding="utf-8")
    return file


def readings() -> np.ndarray:
    """Five rests of 4 s, with turns by 90 deg in 2 s about x, y, z and x between them: (n, 7)."""
    rng = np.random.default_rng(1)
    up, force, rate = np.array([0.0, 0.1, 0.99]) / np.hypot(0.1, 0.99), [], []
    for axis in (0, 1, 2, 0, None):
        force += [up] * 400
        rate += [np.zeros(3)] * 400
        if axis is None:
            continue
        speed = 45.0 * np.eye(3)[axis]
        for _ in range(200):
            up = up - np.radians(np.cross(speed, up)) / RATE_HZ
            up /= np.linalg.norm(up)
            force.append(up)
            rate.append(speed)
    n = len(force)
    a = np.linalg.solve(A[1], np.array(force).T).T + A[0] + 1e-3 * rng.standard_normal((n, 3))
    w = np.linalg.solve(W[1], np.array(rate).T).T + W[0] + 0.05 * rng.standard_normal((n, 3))
    return np.column_stack([np.arange(n) / RATE_HZ, a, w])


def write(path: Path, table: np.ndarray, digits: int = 6) -> Path:
    lines = [",".join(f"{v:.{digits}f}" for v in row) for row in table]
    path.write_text("\n".join([",".join(NAMES), *lines]) + "\n", encoding="utf-8")
    return path


def warnings(calibration: Path, table: np.ndarray, capsys: pytest.CaptureFixture[str], digits: int = 6) -> list[str]:
    log = write(calibration.parent / "log.csv", table, digits)
    assert main(["--calibration", str(calibration), str(log), "-o", str(calibration.parent / "out.csv")]) == 0
    return [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]


def test_a_good_log_is_not_doubted(calibration: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for digits in (6, 12, 17):
        assert warnings(calibration, readings(), capsys, digits) == []


def test_a_sensor_that_is_not_ready_by_the_diagnosis_beside_its_calibration_is_named(
    calibration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = calibration.parent / "results"
    for folder in ("calibrations", "diagnoses"):
        (results / folder).mkdir(parents=True)
    published = results / "calibrations" / "U1.json"
    published.write_bytes(calibration.read_bytes())
    assert warnings(published, readings(), capsys) == []
    parts = {
        "accelerometer": {"verdict": "unexplained", "selected": [], "decided_by": "misfit of the fit, 31 x noise"},
        "gyroscope": {"verdict": "missing_effect", "selected": ["g_sensitivity"]},
    }
    (results / "diagnoses" / "U1.json").write_text(json.dumps(parts))
    assert warnings(published, readings(), capsys) == [
        "warning: the accelerometer is not ready: unexplained, misfit of the fit, 31 x noise",
        "warning: the gyroscope is not ready: effect missing, g_sensitivity",
    ]


def test_a_log_that_this_command_made_is_known_again(calibration: Path, capsys: pytest.CaptureFixture[str]) -> None:
    warnings(calibration, readings(), capsys)
    out = calibration.parent / "out.csv"
    main(["--calibration", str(calibration), str(out), "-o", str(calibration.parent / "twice.csv")])
    said = capsys.readouterr().err
    assert "the readings have 12 decimals, as this command writes them: the log is compensated already" in said
    assert "away from rest: the accelerometer is" in said
    rounded = np.loadtxt(out, delimiter=",", skiprows=1).round(6)
    (told,) = warnings(calibration, rounded, capsys)
    assert "compensated already, or of another unit or sensor, or read with other axes" in told


@pytest.mark.parametrize(
    ("columns", "factor", "message"),
    [
        (slice(1, 4), 9.80665, "the readings look like m/s^2"),
        (slice(1, 4), 1000.0, "the readings look like mg"),
        (slice(1, 4), 0.25, "another unit, another range"),
        (slice(4, 7), np.pi / 180.0, "its readings look like rad/s"),
    ],
)
def test_readings_in_another_unit_are_named(
    calibration: Path, capsys: pytest.CaptureFixture[str], columns: slice, factor: float, message: str
) -> None:
    table = readings()
    table[:, columns] *= factor
    assert any(message in line for line in warnings(calibration, table, capsys))


@pytest.mark.parametrize(
    ("columns", "factor", "offset", "expected"),
    [
        (slice(4, 7), 5.0, 0.0, r"the gyroscope is at least 9\.\d deg/s from zero"),  # 4 |bias| are 9.2
        (slice(4, 7), 1.0, 8.0, r"the gyroscope is at least 1[34] deg/s from zero"),  # sqrt(3) * 8
        (slice(1, 4), 0.92, 0.0, r"the accelerometer is at least 0\.0[5-9]\d* g from 1 g"),
        (slice(4, 7), 1.0, 1.0, None),  # a bias that has changed
    ],
)
def test_rests_that_no_window_brings_to_rest_are_doubted(  # noqa: PLR0917  (a case of the table)
    calibration: Path,
    capsys: pytest.CaptureFixture[str],
    columns: slice,
    factor: float,
    offset: float,
    expected: str | None,
) -> None:
    table = readings()
    table[:, columns] = factor * table[:, columns] + offset
    said = warnings(calibration, table, capsys)
    if expected is None:
        assert said == []
    else:
        assert any("is at rest after compensation" in line and re.search(expected, line) for line in said), said


def test_a_calibration_that_holds_the_factor_of_another_range_is_not_doubted(
    calibration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = json.loads(calibration.read_text())
    for sensor in ("accelerometer", "gyroscope"):
        part = document[sensor]
        part["matrix"] = (np.array(part["matrix"]) / 4.0).tolist()
        part["bias"] = (np.array(part["bias"]) * 4.0).tolist()
    calibration.write_text(json.dumps(document))
    table = readings()
    table[:, 1:] *= 4.0
    assert warnings(calibration, table, capsys) == []


def test_raw_counts_are_named(calibration: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = readings()
    table[:, 1:] = np.round(table[:, 1:] * np.repeat([16384.0, 131.0], 3))
    said = warnings(calibration, table, capsys)
    assert [s for s in ("accelerometer", "gyroscope") if any(f"the {s} are whole numbers" in t for t in said)] == [
        "accelerometer",
        "gyroscope",
    ]


def test_time_that_repeats_or_runs_backwards_is_named(calibration: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = readings()
    table[500:, 0] -= 3.0
    table[700, 0] = table[699, 0]
    said = warnings(calibration, table, capsys)
    assert said[0].startswith("warning: the time runs backwards at 1 of 2800 samples, first at sample 501, 2 s: ")
    assert said[1] == "warning: the time of 1 of 2800 samples is that of the sample before"


def test_other_axes_and_another_unit_are_doubted(calibration: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for axes in ([1, 0, 2], [1, 2, 0], [2, 0, 1]):
        table = readings()
        table[:, 1:] = table[:, [1 + i for i in axes] + [4 + i for i in axes]]
        (told,) = warnings(calibration, table, capsys)
        assert "away from rest" in told
        assert "of another unit or sensor, or read with other axes" in told


def test_a_link_stays_and_its_file_keeps_its_permissions(calibration: Path, tmp_path: Path) -> None:
    log = write(tmp_path / "log.csv", readings()[:50])
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "real.csv").write_text("old")
    (folder / "real.csv").chmod(0o640)
    (tmp_path / "link.csv").symlink_to(folder / "real.csv")
    (tmp_path / "new.csv").symlink_to(folder / "made.csv")
    for name in ("link.csv", "new.csv"):
        main(["--calibration", str(calibration), str(log), "-o", str(tmp_path / name)])
        assert (tmp_path / name).is_symlink()
    assert (folder / "real.csv").read_text() == (folder / "made.csv").read_text()
    assert (folder / "real.csv").read_text().startswith("time_s,")
    assert stat.S_IMODE((folder / "real.csv").stat().st_mode) == 0o640
    assert sorted(f.name for f in folder.iterdir()) == ["made.csv", "real.csv"]


def test_what_fails_leaves_the_output_that_was_there(calibration: Path, tmp_path: Path) -> None:
    log = write(tmp_path / "log.csv", readings()[:50])
    log.write_text(log.read_text() + "60.0,1,2,x,1,1,1\n")
    (tmp_path / "out.csv").write_text("old")
    with pytest.raises(InputError, match="a finite number is expected"):
        main(["--calibration", str(calibration), str(log), "-o", str(tmp_path / "out.csv")])
    assert (tmp_path / "out.csv").read_text() == "old"
    assert sorted(f.name for f in tmp_path.iterdir()) == ["U1.json", "log.csv", "out.csv"]


def test_standard_output_and_devices_are_written_to(
    calibration: Path, tmp_path: Path, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    log = write(tmp_path / "log.csv", readings()[:50])
    main(["--calibration", str(calibration), str(log), "-o", str(tmp_path / "out.csv")])
    expected = (tmp_path / "out.csv").read_bytes()
    words = ["--calibration", str(calibration), str(log), "-o"]
    for target in ("-", "/dev/stdout"):
        capfdbinary.readouterr()
        os.write(1, b"before\n")  # standard output is a file here, which must not be truncated
        main([*words, target])
        assert capfdbinary.readouterr().out == b"before\n" + expected
    main([*words, "/dev/null"])
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)
    with pytest.raises(InputError, match=r"/dev/full: the output cannot be written: No space"):
        main([*words, "/dev/full"])


def test_what_is_no_log_and_no_place_for_one_is_refused(calibration: Path, tmp_path: Path) -> None:
    log = write(tmp_path / "log.csv", readings()[:50])
    os.mkfifo(tmp_path / "pipe.csv")
    pointer = tmp_path / "pointer.csv"
    pointer.write_text(f"version https://git-lfs.github.com/spec/v1\noid sha256:{'4d7a2146' * 8}\nsize 12345\n")
    cases = [
        (pointer, tmp_path / "out.csv", "is a Git LFS pointer, not the file itself: run git lfs pull$"),
        (tmp_path / "pipe.csv", tmp_path / "out.csv", "a FIFO"),
        (tmp_path, tmp_path / "out.csv", "a directory"),
        (Path("/dev/null"), tmp_path / "out.csv", "is a device"),
        (log, tmp_path, "the output is a directory"),
        (log, tmp_path / "none" / "out.csv", "directory of the output does not exist"),
        (log, tmp_path / "out.mcap", "the log is text, and so is the output"),
        (log, calibration, "would overwrite the calibration"),
        (log, log, "would overwrite the log"),
    ]
    for source, target, message in cases:
        with pytest.raises(InputError, match=message):
            main(["--calibration", str(calibration), str(source), "-o", str(target)])
