from __future__ import annotations

import csv
import json
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from unit_settings import ingest_of

from pipeline.app.commands.apply import main
from pipeline.app.field_logs.stream import LogProfile, compensate_log
from pipeline.core.errors import ConfigurationError, ConvergenceError, InputError, MissingInputError
from pipeline.core.records import Coefficient, FittedEffect, SensorCalibration
from pipeline.physics.compensation import load

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

HEADER = (
    "time_s,accel_x_g,accel_y_g,accel_z_g,remark,gyro_x_dps,gyro_y_dps,gyro_z_dps,temperature_degc,table_rate_dps,count"
)

VALUES = [*(f"accel_{a}_g" for a in "xyz"), *(f"gyro_{a}_dps" for a in "xyz")]


def effect(name: str, **values: float) -> FittedEffect:
    return FittedEffect(name, {k: Coefficient(v, "", 0.0) for k, v in values.items()})


def nine(symbol: str, value: float) -> dict[str, float]:
    return {f"{symbol}_{a}{b}": value for a in "xyz" for b in "xyz"}


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    accelerometer = SensorCalibration(
        "accelerometer", np.array([0.02, -0.01, 0.03]), np.diag([1.01, 0.99, 1.02]),
        effects=(effect("inner_lever_arms", **nine("r", 3e-3)),),
    )  # fmt: skip
    gyroscope = SensorCalibration(
        "gyroscope", np.array([1.0, -2.0, 0.5]), np.eye(3) + 0.01,
        effects=(
            effect("bias_temperature", b_T_x=0.1, b_T_y=0.2, b_T_z=-0.1),
            effect("g_sensitivity", **nine("G", 0.05)),
            effect("warm_up", A_x=0.3, A_y=0.2, A_z=0.1, time_constant=60.0),
        ),
    )  # fmt: skip
    file = tmp_path / "U1.json"
    parts = {"accelerometer": accelerometer.to_json(), "gyroscope": gyroscope.to_json()}
    file.write_text(
        json.dumps({"unit": "U1", "schema_version": 1, "status": "ok", "error": None, **parts}), encoding="utf-8"
    )
    return file


@pytest.fixture
def log(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    n = 500
    lines = [HEADER]
    for i in range(n):
        a, g = rng.standard_normal(3), 50.0 * rng.standard_normal(3)
        remark = '"a, ""b"""' if i % 100 == 7 else "ok"
        temperature = 25.0 + 0.01 * i + 0.05 * rng.standard_normal()
        values = [f"{0.12 * i:.2f}", *(f"{v:.6f}" for v in a), remark, *(f"{v:.5f}" for v in g)]
        lines.append(",".join([*values, f"{temperature:.3f}", "007.500", f"{i:04d}"]))
    file = tmp_path / "log.csv"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


def columns(file: Path) -> dict[str, list[str]]:
    with file.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.reader(stream))
    return {name: [row[i] for row in rows[1:]] for i, name in enumerate(rows[0])}


def vectors(table: dict[str, list[str]], sensor: str) -> np.ndarray:
    names = [f"accel_{a}_g" for a in "xyz"] if sensor == "accelerometer" else [f"gyro_{a}_dps" for a in "xyz"]
    return np.array([table[name] for name in names], float).T


def test_a_log_is_compensated_as_its_arrays_are(calibration: Path, log: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.csv"
    assert main(["--calibration", str(calibration), str(log), "-o", str(out)]) == 0
    before, after = columns(log), columns(out)
    temperature, time = np.array(before["temperature_degc"], float), np.array(before["time_s"], float)
    expected = load(calibration).apply(
        vectors(before, "accelerometer"), vectors(before, "gyroscope"), temperature, time
    )
    assert vectors(after, "accelerometer") == pytest.approx(expected.accelerometer, abs=2e-12)
    assert vectors(after, "gyroscope") == pytest.approx(expected.gyroscope, abs=1e-10)


def resting_log(file: Path, still_s: float) -> Path:
    """Write a log at 100 Hz: at rest up to ``still_s`` after 1 s of motion, then 30 deg/s about z for 5 s."""
    rng = np.random.default_rng(3)
    time = np.arange(0.0, still_s + 5.0, 0.01)
    rate = np.where(time > still_s, 30.0, np.where(time < 1.0, 20.0 * np.sin(9.0 * time), 0.0))
    gyroscope = np.outer(rate, [0.0, 0.0, 1.0]) + 0.1 * rng.standard_normal((len(time), 3)) + [1.3, -2.2, 0.6]
    force = [0.0, 0.0, 1.0] + 2e-3 * rng.standard_normal((len(time), 3)) * (1.0 + 50.0 * (time < 1.0))[:, None]
    table = np.column_stack([100.0 + time, force, gyroscope])
    names = ["time_s", *VALUES]
    lines = [",".join(names), *(",".join(f"{v:.6f}" for v in row) for row in table)]
    file.write_text("\n".join(lines), encoding="utf-8")
    return file


def without_effects(calibration: Path, matrix: np.ndarray | None = None) -> None:
    """Take off the effects; ``matrix``: of the gyroscope."""
    data = json.loads(calibration.read_text(encoding="utf-8"))
    for sensor in ("accelerometer", "gyroscope"):
        data[sensor]["effects"] = []
    if matrix is not None:
        data["gyroscope"]["matrix"] = matrix.tolist()
    calibration.write_text(json.dumps(data), encoding="utf-8")


@pytest.mark.parametrize("block_bytes", [1000, 1 << 20])
def test_a_rest_of_the_log_renews_the_bias(calibration: Path, tmp_path: Path, block_bytes: int) -> None:
    matrix = np.array([[1.2, 0.3, 0.0], [-0.1, 0.8, 0.2], [0.1, 0.0, 1.1]])  # far from one: the bias is not in its axes
    without_effects(calibration, matrix)
    log, out = resting_log(tmp_path / "rest.csv", 12.0), tmp_path / "out.csv"
    result = compensate_log(load(calibration), log, out, rest=(0.0, 12.0), block_bytes=block_bytes)
    table = columns(out)
    time, rate = np.array(table["time_s"], float) - 100.0, vectors(table, "gyroscope")
    within = 5.0 * 0.1 * np.linalg.norm(matrix, axis=1).max() / np.sqrt(1000)
    assert rate[(time > 2.0) & (time < 11.0)].mean(axis=0) == pytest.approx(np.zeros(3), abs=within)
    assert rate[time > 12.5].mean(axis=0) == pytest.approx(matrix @ [0.0, 0.0, 30.0], abs=2 * within)
    assert "mean rate of the rest from 1." in result.notes[0]


def test_a_log_that_moves_where_a_rest_is_named_is_refused(calibration: Path, tmp_path: Path) -> None:
    without_effects(calibration)
    log, out = resting_log(tmp_path / "rest.csv", 12.0), tmp_path / "out.csv"
    with pytest.raises(InputError, match=r"no rest of 1 s or more from 0 to 1\.2 s"):
        main(["--calibration", str(calibration), str(log), "-o", str(out), "--rest", "0:1.2"])
    assert not out.exists()
    log.write_text(log.read_text(encoding="utf-8").splitlines()[0] + "\n", encoding="utf-8")  # a log without samples
    with pytest.raises(InputError, match="no rest of 1 s or more"):
        main(["--calibration", str(calibration), str(log), "-o", str(out), "--rest", "0:10"])
    with pytest.raises(ConfigurationError, match="expected FROM:TO"):
        main(["--calibration", str(calibration), str(log), "-o", str(out), "--rest", "10:0"])


def test_other_columns_are_kept_to_the_letter(calibration: Path, log: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.csv"
    main(["--calibration", str(calibration), str(log), "-o", str(out)])
    before, after = columns(log), columns(out)
    assert list(before) == list(after)
    for name in ("time_s", "remark", "temperature_degc", "table_rate_dps", "count"):
        assert before[name] == after[name]
    assert out.read_text(encoding="utf-8").count('"a, ""b"""') == 5


@pytest.mark.parametrize(("block_bytes", "since"), [(150, 0.0), (1000, 0.0), (20_000, 0.0), (1000, 1_700_000_000.0)])
def test_small_blocks_give_what_one_block_gives(
    calibration: Path, log: Path, tmp_path: Path, block_bytes: int, since: float
) -> None:
    """``since``: of the first sample, s; since 1970, time counts from it."""
    head, *rows = log.read_text(encoding="utf-8").splitlines()
    cells = [row.partition(",") for row in rows]
    log.write_text("\n".join([head, *(f"{since + float(t):.2f},{others}" for t, _, others in cells)]), encoding="utf-8")
    compensation = load(calibration)
    whole, cut = tmp_path / "whole.csv", tmp_path / "cut.csv"
    result = compensate_log(compensation, log, whole)
    assert (result.samples, result.sensors) == (500, ["accelerometer", "gyroscope"])
    seen = []
    compensate_log(compensation, log, cut, block_bytes=block_bytes, progress=lambda rows, _: seen.append(rows))
    assert len(seen) > 500 * 60 // block_bytes / 2
    assert cut.read_bytes() == whole.read_bytes()


def test_cells_that_are_empty_stay_empty(calibration: Path, log: Path, tmp_path: Path) -> None:
    lines = log.read_text(encoding="utf-8").splitlines()
    cells = lines[20].split(",")
    lines[20] = ",".join([cells[0], "", *cells[2:]])
    log.write_text("\n".join(lines), encoding="utf-8")
    compensate_log(load(calibration), log, tmp_path / "out.csv")
    table = columns(tmp_path / "out.csv")
    assert table["accel_x_g"][19] == ""
    assert all(table["accel_x_g"][:19] + table["accel_x_g"][20:])


def test_a_sensor_without_calibration_is_left_unchanged_and_said(
    calibration: Path, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = json.loads(calibration.read_text(encoding="utf-8"))
    calibration.write_text(json.dumps({**data, "accelerometer": None}), encoding="utf-8")
    out = tmp_path / "out.csv"
    main(["--calibration", str(calibration), str(log), "-o", str(out)])
    assert "holds no accelerometer" in capsys.readouterr().err
    assert vectors(columns(out), "accelerometer") == pytest.approx(vectors(columns(log), "accelerometer"))


@pytest.mark.parametrize("block_bytes", [1 << 21, 2_000])
def test_samples_beyond_the_calibrated_range_are_counted(
    calibration: Path, log: Path, tmp_path: Path, block_bytes: int
) -> None:
    """Beyond by more than 10 % or 1 degC; a calibration without the range, of an earlier version, says nothing."""
    table = columns(log)
    force, rate = (np.linalg.norm(vectors(table, s), axis=1) for s in ("accelerometer", "gyroscope"))
    warmth = np.array(table["temperature_degc"], float)
    document = json.loads(calibration.read_text())
    assert not [w for w in compensate_log(load(calibration), log, tmp_path / "o.csv").warnings if "beyond" in w]
    document["calibrated_range"] = {
        "specific_force_g": 1.1,
        "angular_rate_dps": 1.01 * float(rate.max()),
        "temperature_degc": [26.5, 29.0],
    }
    calibration.write_text(json.dumps(document))
    result = compensate_log(load(calibration), log, tmp_path / "o.csv", block_bytes=block_bytes)
    force_told, warmth_told = (w for w in result.warnings if "beyond" in w)
    count = np.count_nonzero(force > 1.21)
    assert force_told.startswith(f"{count} of 500 samples")
    assert f"specific force up to {force.max():.3g} g, calibrated up to 1.1 g" in force_told
    out = (warmth < 25.5) | (warmth > 30.0)
    assert warmth_told.startswith(f"{np.count_nonzero(out)} of 500 samples")
    assert f"from {warmth[out].min():.1f} to {warmth[out].max():.1f} degC, calibrated from 26.5" in warmth_told


def test_a_calibrated_sensor_that_the_log_lacks_is_noted(calibration: Path, log: Path, tmp_path: Path) -> None:
    document = json.loads(calibration.read_text(encoding="utf-8"))
    document["accelerometer"]["effects"] = []  # they need the gyroscope
    document["accelerometer"]["covariance"] = {"parameters": [], "values": []}
    calibration.write_text(json.dumps(document), encoding="utf-8")
    lines = [line.split(",") for line in log.read_text(encoding="utf-8").replace('"a, ""b"""', "ok").splitlines()]
    log.write_text("\n".join(",".join(cells[:5]) for cells in lines), encoding="utf-8")
    result = compensate_log(load(calibration), log, tmp_path / "out.csv")
    assert (result.samples, result.sensors) == (500, ["accelerometer"])
    assert [note for note in result.notes if "gyroscope" in note] == [
        "the log holds no readings of the gyroscope, which is calibrated"
    ]


def test_a_byte_order_mark_and_windows_lines_are_read(calibration: Path, log: Path, tmp_path: Path) -> None:
    text = log.read_text(encoding="utf-8")
    plain, windows = tmp_path / "plain.csv", tmp_path / "windows.csv"
    compensate_log(load(calibration), log, plain)
    log.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    compensate_log(load(calibration), log, windows)
    assert windows.read_bytes() == plain.read_bytes()


def test_the_log_is_never_overwritten(calibration: Path, log: Path, tmp_path: Path) -> None:
    (tmp_path / "link.csv").symlink_to(log)
    for target in (log, tmp_path / "link.csv"):
        with pytest.raises(InputError, match="overwrite"):
            main(["--calibration", str(calibration), str(log), "-o", str(target)])


def test_a_failed_run_leaves_no_output(calibration: Path, log: Path, tmp_path: Path) -> None:
    log.write_text(log.read_text(encoding="utf-8") + "60.0,1,2,x,ok,1,1,1,25,0,1\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"log\.csv:502: column accel_z_g .* is 'x'; a finite number is expected"):
        main(["--calibration", str(calibration), str(log), "-o", str(tmp_path / "out.csv")])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["U1.json", "log.csv"]


def test_a_row_with_a_missing_cell_is_refused(calibration: Path, log: Path, tmp_path: Path) -> None:
    log.write_text(log.read_text(encoding="utf-8") + "60.0,1,2\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"log\.csv:502: the line has 3 fields where 11 are expected"):
        main(["--calibration", str(calibration), str(log), "-o", str(tmp_path / "out.csv")])


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("t,ax,ay,az", "expected accel_x_g"),
        ("time_s,accel_x_g,accel_y_g,gyro_x_dps", "but not accel_z_g"),
        ("accel_x_g,accel_x_g,accel_y_g,accel_z_g", "more than once"),
        ("", "got 1, 2, 3, 4"),
    ],
)
def test_a_header_without_the_sensors_is_refused(calibration: Path, tmp_path: Path, header: str, message: str) -> None:
    bad = tmp_path / "bad.csv"
    bad.write_text(f"{header}\n1,2,3,4\n", encoding="utf-8")
    with pytest.raises(InputError, match=message):
        main(["--calibration", str(calibration), str(bad), "-o", str(tmp_path / "out.csv")])


def test_a_signal_that_an_effect_needs_is_named(calibration: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare.csv"
    bare.write_text("gyro_x_dps,gyro_y_dps,gyro_z_dps\n1,2,3\n", encoding="utf-8")
    with pytest.raises(InputError, match="bias_temperature, which needs temperature"):
        main(["--calibration", str(calibration), str(bare), "-o", str(tmp_path / "out.csv")])


def test_a_log_without_rows_gives_a_header(calibration: Path, log: Path, tmp_path: Path) -> None:
    log.write_text(HEADER + "\n", encoding="utf-8")
    assert compensate_log(load(calibration), log, tmp_path / "out.csv").samples == 0
    assert (tmp_path / "out.csv").read_text(encoding="utf-8") == HEADER + "\n"
    log.write_text("\n\n", encoding="utf-8")
    with pytest.raises(InputError, match="the file is empty"):
        compensate_log(load(calibration), log, tmp_path / "out.csv")


def test_a_missing_log_is_refused(calibration: Path, tmp_path: Path) -> None:
    arguments = ["--calibration", str(calibration), "-o", str(tmp_path / "out.csv")]
    with pytest.raises(MissingInputError, match="no such log"):
        main([*arguments, str(tmp_path / "none.csv")])


def test_a_reading_out_of_reach_is_refused_with_its_line(log: Path, tmp_path: Path) -> None:
    cubic = SensorCalibration("accelerometer", effects=(effect("cubic_nonlinearity", K3_x=5e-3, K3_y=5e-3, K3_z=5e-3),))
    file = tmp_path / "U2.json"
    part = {"accelerometer": cubic.to_json(), "gyroscope": None}
    file.write_text(
        json.dumps({"unit": "U2", "schema_version": 1, "status": "ok", "error": None, **part}), encoding="utf-8"
    )
    log.write_text("accel_x_g,accel_y_g,accel_z_g\n0,0,1\n0,0,900\n", encoding="utf-8")
    with pytest.raises(ConvergenceError, match=r"log\.csv:2: .*reading of 900"):
        main(["--calibration", str(file), str(log), "-o", str(tmp_path / "out.csv")])


def test_a_user_error_is_one_line_and_exit_code_2(calibration: Path, log: Path) -> None:
    command = [sys.executable, "-m", "pipeline", "apply", "--calibration", str(calibration), str(log), "-o", str(log)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 2
    assert len(run.stderr.splitlines()) == 1


def with_profile(calibration: Path, csv_section: dict[str, Any], axis_map: Sequence[str] = ("+x", "+y", "+z")) -> Path:
    """State in a calibration how the unit's logs are laid out, as a run does."""
    data = json.loads(calibration.read_text(encoding="utf-8"))
    log = {"ingest": {"csv": csv_section, "mcap": {}}, "axis_map": list(axis_map)}
    for sensor in ("accelerometer", "gyroscope"):
        data[sensor]["effects"] = []
        data[sensor]["covariance"] = {"parameters": [], "values": []}
    calibration.write_text(json.dumps({**data, "sensor": "mpu6050", "log": log}), encoding="utf-8")
    return calibration


@pytest.mark.parametrize(
    "changed", [{"ingest": {"csv": {}, "delimiters": ";"}}, {"ingest": {"csv": "columns"}}, {"axis_map": ["+x"]}]
)
def test_a_damaged_profile_of_a_calibration_is_refused_by_name(calibration: Path, changed: dict[str, Any]) -> None:
    data = json.loads(with_profile(calibration, counts_profile()).read_text(encoding="utf-8"))
    data["log"] |= changed
    with pytest.raises(InputError, match="log is invalid"):
        LogProfile.of_calibration(data, str(calibration))


def counts_profile(**more: Any) -> dict[str, Any]:
    scales = {"accel": ("a", 16384.0), "gyro": ("g", 131.0)}
    columns: dict[str, Any] = {"time": {"column": "time_ms", "unit": "ms"}}
    for name, (letter, scale) in scales.items():
        for a in "xyz":
            columns[f"{name}_{a}"] = {
                "column": f"{letter}{a}",
                "unit": "counts",
                "counts_per_unit": scale,
                "offset": 5.0,
            }
    return {"columns": columns, **more}


def raw_counts(n: int = 50) -> np.ndarray:
    return np.random.default_rng(1).integers(-20_000, 20_000, (n, 6))


def expected_of_counts(calibration: Path, counts: np.ndarray) -> np.ndarray:
    found = load(calibration).apply((counts[:, :3] - 5) / 16384.0, (counts[:, 3:] - 5) / 131.0)
    return np.column_stack([found.accelerometer, found.gyroscope])


def test_raw_counts_are_read_as_the_units_recordings_were(calibration: Path, tmp_path: Path) -> None:
    with_profile(calibration, counts_profile())
    counts = raw_counts()
    rows = [f"{10 * i},{','.join(map(str, row))},note {i}" for i, row in enumerate(counts.tolist())]
    (tmp_path / "log.csv").write_text("time_ms,ax,ay,az,gx,gy,gz,remark\n" + "\n".join(rows) + "\n")
    main(["--calibration", str(calibration), str(tmp_path / "log.csv"), "-o", str(tmp_path / "out.csv")])
    after = columns(tmp_path / "out.csv")
    assert list(after) == ["time_ms", *VALUES, "remark"]
    found = np.array([after[name] for name in VALUES], float).T
    np.testing.assert_allclose(found, expected_of_counts(calibration, counts), atol=1e-12, rtol=1e-13)
    assert after["time_ms"][7] == "70"
    assert after["remark"][7] == "note 7"


def test_another_profile_is_named_on_the_command_line(calibration: Path, log: Path, tmp_path: Path) -> None:
    with_profile(calibration, counts_profile())
    arguments = ["--calibration", str(calibration), str(log), "-o", str(tmp_path / "out.csv")]
    with pytest.raises(InputError, match=r"expected ax, ay, .*--ingest"):
        main(arguments)
    main([*arguments, "--ingest", "canonical_csv"])
    before = columns(log)
    expected = load(calibration).apply(vectors(before, "accelerometer"), vectors(before, "gyroscope"))
    found = columns(tmp_path / "out.csv")
    assert vectors(found, "accelerometer") == pytest.approx(expected.accelerometer, abs=2e-12)
    with pytest.raises(ConfigurationError, match="no such ingest"):
        main([*arguments, "--ingest", "phase_of_the_moon"])


def test_a_log_with_another_separator_is_named_so_and_read_by_the_campaigns_own_profile(
    calibration: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_profile(calibration, counts_profile(delimiter="semicolon"))
    counts = raw_counts()
    rows = [f"{10 * i},{','.join(map(str, row))}" for i, row in enumerate(counts.tolist())]
    (tmp_path / "log.csv").write_text("time_ms,ax,ay,az,gx,gy,gz\n" + "\n".join(rows) + "\n")
    arguments = ["--calibration", str(calibration), str(tmp_path / "log.csv"), "-o", str(tmp_path / "out.csv")]
    with pytest.raises(InputError, match="is the separator ','"):
        main(arguments)
    own = tmp_path / "bench" / "configs" / "ingest" / "logger.yaml"
    own.parent.mkdir(parents=True)
    own.write_text(json.dumps({"name": "logger", "csv": counts_profile(delimiter="comma")}), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    for profile in ("logger", str(own)):
        main([*arguments, "--ingest", profile])
        after = columns(tmp_path / "out.csv")
        found = np.array([after[name] for name in VALUES], float).T
        np.testing.assert_allclose(found, expected_of_counts(calibration, counts), atol=1e-12, rtol=1e-13)
        (tmp_path / "out.csv").unlink()


@pytest.mark.parametrize("block_bytes", [97, 1 << 20])
def test_a_log_of_other_dress_keeps_it(calibration: Path, tmp_path: Path, block_bytes: int) -> None:
    dress = {"delimiter": ";", "decimal": ",", "comment": "#", "skip_lines": 1}
    profile = LogProfile(ingest_of({"csv": counts_profile(**dress)}))
    with_profile(calibration, counts_profile(**dress))
    counts = raw_counts()
    rows = [f"{10 * i},5;{';'.join(f'{v},0' for v in row)}" for i, row in enumerate(counts.tolist())]
    rows.insert(20, "# a pause")
    text = "Fs;100\n# made by hand\ntime_ms;ax;ay;az;gx;gy;gz\n" + "\n".join(rows) + "\n"
    (tmp_path / "log.txt").write_text(text)
    compensate_log(load(calibration), tmp_path / "log.txt", tmp_path / "out.txt", profile, block_bytes=block_bytes)
    lines = (tmp_path / "out.txt").read_text().splitlines()
    assert lines[:3] == ["Fs;100", "# made by hand", ";".join(["time_ms", *VALUES])]
    cells = [line.replace(",", ".").split(";") for line in lines[3:]]
    np.testing.assert_allclose(
        np.array(cells, float)[:, 1:], expected_of_counts(calibration, counts), atol=1e-12, rtol=1e-13
    )
    bad = text.replace("70,5;", "70,5;x", 1)
    (tmp_path / "log.txt").write_text(bad)
    line = 1 + next(i for i, row in enumerate(bad.splitlines()) if "x" in row and row.startswith("70"))
    with pytest.raises(InputError, match=rf"log\.txt:{line}: column ax .* is"):
        compensate_log(load(calibration), tmp_path / "log.txt", tmp_path / "out.txt", profile, block_bytes=block_bytes)


def test_blanks_between_columns_without_names_and_a_rate_for_the_time(calibration: Path, tmp_path: Path) -> None:
    data = json.loads(calibration.read_text(encoding="utf-8"))
    channels = [f"{s}_{a}" for s in ("accel", "gyro") for a in "xyz"]
    units = ["g"] * 3 + ["deg/s"] * 3
    places = {c: {"column": i, "unit": u} for i, (c, u) in enumerate(zip(channels, units, strict=True))}
    places["temperature"] = {"column": 6, "unit": "degC"}
    profile = LogProfile(
        ingest_of({"csv": {"header": False, "delimiter": "whitespace", "rate_hz": 50.0, "columns": places}})
    )
    values = np.round(np.random.default_rng(3).normal(0, 1, (40, 7)), 4)
    text = "\n".join("  ".join(f"{v}" for v in row) + " " for row in values.tolist())
    (tmp_path / "log.txt").write_text(text)
    assert "effects" in data["gyroscope"]
    compensate_log(load(calibration), tmp_path / "log.txt", tmp_path / "out.txt", profile)
    found = np.loadtxt(tmp_path / "out.txt")
    expected = load(calibration).apply(values[:, :3], values[:, 3:6], values[:, 6], np.arange(40) / 50.0)
    np.testing.assert_allclose(found[:, :3], expected.accelerometer, atol=1e-12)
    np.testing.assert_allclose(found[:, 3:6], expected.gyroscope, atol=1e-12)
    np.testing.assert_array_equal(found[:, 6], values[:, 6])


def test_the_axes_of_the_sensor_are_turned_to_the_bodys(calibration: Path, tmp_path: Path) -> None:
    with_profile(calibration, counts_profile(), ("+y", "-x", "+z"))  # body x is minus the reading's y, body y its x
    counts = raw_counts()
    rows = [f"{10 * i},{','.join(map(str, row))}" for i, row in enumerate(counts.tolist())]
    (tmp_path / "log.csv").write_text("time_ms,ax,ay,az,gx,gy,gz\n" + "\n".join(rows) + "\n")
    main(["--calibration", str(calibration), str(tmp_path / "log.csv"), "-o", str(tmp_path / "out.csv")])
    readings = np.column_stack([(counts[:, :3] - 5) / 16384.0, (counts[:, 3:] - 5) / 131.0])
    turned = np.column_stack(
        [-readings[:, 1], readings[:, 0], readings[:, 2], -readings[:, 4], readings[:, 3], readings[:, 5]]
    )
    expected = load(calibration).apply(turned[:, :3], turned[:, 3:])
    after = columns(tmp_path / "out.csv")
    found = np.array([after[name] for name in VALUES], float).T
    np.testing.assert_allclose(found, np.column_stack(expected), atol=1e-12, rtol=1e-13)


@pytest.mark.parametrize("named", [("a.txt", "g.txt"), ("g.txt", "a.txt"), ("g.txt",)])
def test_joined_files_give_what_one_file_gives(calibration: Path, tmp_path: Path, named: tuple[str, ...]) -> None:
    columns_of = counts_profile()["columns"]
    parts = [
        {"file": file, "columns": {c: v for c, v in columns_of.items() if not c.startswith(other)}}
        for file, other in (("a.txt", "gyro"), ("g.txt", "accel"))
    ]
    table = {"columns": {"time": columns_of["time"], "table_angle": {"column": "deg", "unit": "deg"}}}
    parts.append({"file": "t.txt", "own_clock": True, **table})  # a table's log, which another log has not
    with_profile(calibration, {"parts": parts, "columns": {}}, ("+y", "-x", "+z"))
    counts = raw_counts()
    for file, letter, rows in (("a.txt", "a", counts[:, :3]), ("g.txt", "g", counts[:, 3:])):
        lines = [f"{5 * k},{','.join(map(str, row))}" for k, row in enumerate(rows.tolist())]
        (tmp_path / file).write_text("\n".join([f"time_ms,{letter}x,{letter}y,{letter}z", *lines, ""]))
    out = tmp_path / "out.csv"
    files = [str(tmp_path / name) for name in named]
    assert main(["--calibration", str(calibration), *files, "-o", str(out)]) == 0
    scaled = [(part - 5) / scale for part, scale in ((counts[:, :3], 16384.0), (counts[:, 3:], 131.0))]
    found = load(calibration).apply(*(np.column_stack([-v[:, 1], v[:, 0], v[:, 2]]) for v in scaled))
    after = columns(out)
    for sensor, expected in (("accelerometer", found.accelerometer), ("gyroscope", found.gyroscope)):
        np.testing.assert_allclose(vectors(after, sensor), expected, atol=1e-12, rtol=1e-13)
    np.testing.assert_allclose(np.array(after["time_s"], float), 0.005 * np.arange(len(counts)), atol=1e-12)
    (tmp_path / "a.txt").unlink()
    with pytest.raises(InputError, match="there is no such log"):
        main(["--calibration", str(calibration), str(tmp_path / "g.txt"), "-o", str(out)])


def test_several_logs_that_no_profile_joins_are_refused(calibration: Path, log: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="apply reads one log, unless the profile joins several files"):
        main(["--calibration", str(calibration), str(log), str(log), "-o", str(tmp_path / "o.csv")])
