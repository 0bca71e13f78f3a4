"""What is proposed for an unknown log is what its writer meant, and reads it bit for bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from loggers import GRAVITY, INTERVAL_S, LOGGERS, Logger, motion
from unit_settings import ingest_of

from imu_logs.columns import find_layout
from imu_logs.profile import Checks, csv_formats
from imu_logs.proposal import Proposal
from imu_logs.text_read import read_csv
from pipeline.app.config.compose import Composer
from pipeline.app.unit_guesses import propose
from pipeline.core.errors import IngestError

REFERENCE = Path(__file__).parents[3] / "shared" / "data"


def proposed(*files: Path) -> Proposal:
    (proposal,) = propose([find_layout(f.read_bytes(), str(f)) for f in files])
    return proposal


def written(folder: Path, logger: Logger) -> Path:
    file = folder / logger.name
    file.write_text(logger.text(), encoding="utf-8")
    return file


@pytest.mark.parametrize("kind", LOGGERS)
def test_proposal_says_what_the_logger_meant(tmp_path: Path, kind: str) -> None:
    logger = LOGGERS[kind]
    proposal = proposed(written(tmp_path, logger))
    assert tuple(proposal.unknown()) == logger.unknown, proposal.evidence
    for key, value in logger.expected.get("csv", {}).items():
        assert proposal.csv[key] == value, key
    for channel, entry in logger.expected.items():
        if channel != "csv":
            found = proposal.columns[0][channel]
            assert {k: found.get(k) for k in entry} == entry, (channel, proposal.evidence)


@pytest.mark.parametrize("kind", [k for k, logger in LOGGERS.items() if not logger.unknown])
def test_a_saved_proposal_works_as_a_profile(tmp_path: Path, kind: str) -> None:
    """Read through Hydra with it, the log gives the motion that was written."""
    file = written(tmp_path, LOGGERS[kind])
    profile = tmp_path / "configs" / "ingest" / "mine.yaml"
    profile.parent.mkdir(parents=True)
    profile.write_text(proposed(file).text("mine"), encoding="utf-8")
    config = Composer(tmp_path).unit("U1", ["procedure=multi_position", "ingest=mine"])
    table = read_csv([file], csv_formats(config.ingest), Checks())
    data = motion()
    offset = LOGGERS[kind].offset
    tolerance = {"a": 0.02, "g": 0.06} if offset else {"a": 2e-3, "g": 2e-2}
    for index, channel in enumerate(("accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z"), 1):
        scale = np.abs(data[:, index]).max()
        np.testing.assert_allclose(table.values[channel], data[:, index], rtol=0, atol=tolerance[channel[0]] * scale)
    np.testing.assert_allclose((table.time_ns - table.time_ns[0]) / 1e9, data[:, 0], rtol=0, atol=2e-6)


def test_scale_of_the_xsens_counts_is_found_as_its_certificate_says(reference: Path) -> None:
    folder = reference / "xsens_mti_multi_position"
    proposal = proposed(folder / "accelerometer.txt", folder / "gyroscope.txt")
    assert proposal.complete
    assert proposal.parts == ["accelerometer.txt", "gyroscope.txt"]
    accelerometer, gyroscope = proposal.columns[0]["accel_x"], proposal.columns[1]["gyro_x"]
    assert accelerometer["offset"] == gyroscope["offset"] == 32768.0
    assert accelerometer["counts_per_unit"] == pytest.approx(414.0 * GRAVITY, rel=0.02)
    assert gyroscope["counts_per_unit"] == pytest.approx(4767.0 * np.pi / 180, rel=0.02)


@pytest.mark.parametrize("counts", [1300.0, 3200.0, 12500.0])
def test_counts_far_from_every_usual_scale_keep_their_own(tmp_path: Path, counts: float) -> None:
    logger = Logger("ax,ay,az,gx,gy,gz", (0.0, counts, 131.0), {}, whole=True)
    entry = proposed(written(tmp_path, logger)).columns[0]["accel_x"]
    assert entry["unit"] == "counts"
    assert entry["counts_per_unit"] == pytest.approx(counts, rel=0.05)


def test_files_of_one_shape_share_what_one_of_them_tells(reference: Path) -> None:
    """The counts of a rest alone do not tell the gyroscope's scale; a log with moves of the same logger does."""
    folder = reference / "mpu6050_multi_position"
    rest, moves = folder / "imu_static_test.csv", folder / "example_data_calibration.csv"
    assert proposed(rest).unknown() == ["gyro_x", "gyro_y", "gyro_z"]
    proposal = proposed(rest, moves)
    assert proposal.complete
    assert proposal.csv["rate_hz"] == 100.0
    assert proposal.columns[0]["accel_y"]["counts_per_unit"] == 16384.0
    assert proposal.columns[0]["gyro_y"]["counts_per_unit"] == 131.0
    assert "example_data_calibration.csv" in proposal.evidence["gyroscope"]


def test_units_of_the_wearable_are_found_and_its_rate_is_asked_for(reference: Path) -> None:
    proposal = proposed(reference / "ferraris_wearable" / "example_ferraris_session.csv")
    assert proposal.unknown() == ["time"]
    assert proposal.columns[0]["time"]["column"] == "n_samples"
    assert (proposal.columns[0]["accel_x"]["unit"], proposal.columns[0]["gyro_x"]["unit"]) == ("m/s^2", "deg/s")


def test_sessions_one_after_the_other_are_noticed(reference: Path) -> None:
    proposal = proposed(reference / "ferraris_wearable" / "annotated_session.csv")
    assert proposal.columns[0]["accel_x"]["counts_per_unit"] == 2048.0
    assert any("does not increase at 5 rows" in r for r in proposal.remarks)
    text = proposal.text("annotated")
    assert "# not used: part (not all of it is numbers)" in text
    assert "column part labels 9 parts (x_a, x_p, x_rot, y_a ..)" in text
    assert "docs/record.md#parts" in text
    assert not any(
        "labels" in r for r in proposed(reference / "ferraris_wearable" / "example_ferraris_session.csv").remarks
    )


@pytest.mark.parametrize("cell", ["a: b", "x # y", "no", "${sensor.name}", 'say "ax"', "1e3", "ü"])
def test_odd_names_of_columns_survive_yaml_and_hydra(tmp_path: Path, cell: str) -> None:
    names = {"time": f"time {cell} [s]", "accel_x": "ax", "accel_y": "ay", "accel_z": "az"}
    header = ",".join('"' + n.replace('"', '""') + '"' for n in names.values())
    rows = "".join(f"{0.01 * i:.2f},0,0,1\n" for i in range(50))
    file = tmp_path / "log.csv"
    file.write_text(f"{header}\n{rows}", encoding="utf-8")
    profile = tmp_path / "configs" / "ingest" / "mine.yaml"
    profile.parent.mkdir(parents=True)
    text = proposed(file).text("mine")
    profile.write_text(text, encoding="utf-8")
    config = Composer(tmp_path).unit("U1", ["procedure=multi_position", "ingest=mine"])
    assert config.ingest.csv["columns"]["time"]["column"] == names["time"]
    assert read_csv([file], csv_formats(config.ingest)).time_ns[-1] == 490_000_000


def test_text_without_a_table_is_refused_with_its_beginning(tmp_path: Path) -> None:
    with pytest.raises(IngestError, match="no table of numbers was found in it; it starts with 'Dear reader"):
        find_layout(b"Dear reader,\nthere is nothing here.\n", str(tmp_path / "letter.txt"))


def test_a_counter_of_samples_is_no_time_until_its_rate_is_stated() -> None:
    text = "n,ax,ay,az\n" + "".join(f"{i},0,0,1.0\n" for i in range(100))
    (proposal,) = propose([find_layout(text.encode(), "log.csv")])
    entry: dict[str, Any] = yaml.safe_load(proposal.text("mine"))["csv"]["columns"]["time"]
    assert entry == {"column": "n", "unit": "counts", "counts_per_unit": "???"}


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("millis,AcX,AcY,AcZ,GyX,GyY,GyZ", ("millis", "ms", "AcX", "GyZ")),
        ("Zeit [s],ax_raw,ay_raw,az_raw,gx_raw,gy_raw,gz_raw", ("Zeit [s]", "s", "ax_raw", "gz_raw")),
        ("time_ticks,accX,accY,accZ,gyroX,gyroY,gyroZ", ("time_ticks", "counts", "accX", "gyroZ")),
    ],
)
def test_common_names_are_known(header: str, expected: tuple[str, ...]) -> None:
    step = {"ms": 10.0, "s": 0.01}.get(expected[1], 160.0)
    text = header + "\n" + "".join(f"{step * i:g},0.01,0.02,0.99,{0.1 * (i % 3)},0.1,0.2\n" for i in range(200))
    columns = propose([find_layout(text.encode(), "log.csv")])[0].columns[0]
    found = [columns[c]["column"] for c in ("time", "accel_x", "gyro_z")]
    assert [found[0], columns["time"]["unit"], *found[1:]] == list(expected)
    assert (columns["time"].get("counts_per_unit") == "???") == (expected[1] == "counts")


def counts_of_a_slow_turn(turns: float = 1.0) -> str:
    """Write a bench's log of registers: 24 deg/s about x and back, 8192 counts a g, 65.5 a deg/s, 340 a degC."""
    rate = 24.0 * turns * np.where(np.arange(3000) < 1500, 1.0, -1.0)
    angle = np.cumsum(rate) * INTERVAL_S
    force = 8192 * np.column_stack([0 * angle, np.sin(np.radians(angle)), np.cos(np.radians(angle))])
    rates = np.column_stack([65.5 * rate, 0 * force[:, :2]]) + 90
    noise = np.random.default_rng(3).normal(0, 3, (3000, 6))
    readings = np.rint(np.column_stack([force, rates]) + noise).astype(int)
    rows = (
        f"{10_000 * i},{r[0]},{r[1]},{r[2]},-1182,{r[3]},{r[4]},{r[5]},{a:.2f}"
        for i, (r, a) in enumerate(zip(readings, angle, strict=True))
    )
    return "\n".join(["t_us,axr,ayr,azr,tempC_raw,gxr,gyr,gzr,enc_deg", *rows, ""])


def test_registers_under_names_that_differ_in_one_letter_are_read_as_counts(tmp_path: Path) -> None:
    layout = find_layout(counts_of_a_slow_turn().encode(), "log.csv")
    (proposal,) = propose([layout])
    assert [proposal.columns[0][c]["column"] for c in ("accel_x", "accel_z", "gyro_y")] == ["axr", "azr", "gyr"]
    assert proposal.unknown() == ["temperature"]
    assert "degC = counts / 340 + 36.53" in proposal.evidence["temperature"]
    profile = tmp_path / "configs" / "ingest" / "mine.yaml"
    profile.parent.mkdir(parents=True)
    config = Composer(tmp_path).unit("U1", ["sensor=mpu6050", "sensor.accelerometer.range=4"])
    (proposal,) = propose([layout], config.sensor)
    profile.write_text(proposal.text("mine"), encoding="utf-8")
    csv = Composer(tmp_path).unit("U1", ["sensor=mpu6050", "ingest=mine"]).ingest.csv["columns"]
    assert [csv[c]["counts_per_unit"] for c in ("accel_y", "gyro_y", "temperature")] == [8192.0, 65.5, 340.0]
    assert (-1182 - csv["temperature"]["offset"]) / 340.0 == pytest.approx(-1182 / 340 + 36.53)


def test_counts_that_a_log_at_rest_does_not_tell_are_those_of_the_stated_sensor(tmp_path: Path) -> None:
    layout = find_layout(counts_of_a_slow_turn(turns=0.0).encode(), "log.csv")
    assert propose([layout])[0].unknown() == ["gyro_x", "gyro_y", "gyro_z", "temperature"]
    ranges = ["sensor=mpu6050", "sensor.accelerometer.range=4", "sensor.gyroscope.range=500"]
    (proposal,) = propose([layout], Composer(tmp_path).unit("U1", ranges).sensor)
    profile = tmp_path / "configs" / "ingest" / "mine.yaml"
    profile.parent.mkdir(parents=True)
    profile.write_text(proposal.text("mine"), encoding="utf-8")
    config = Composer(tmp_path).unit("U1", [*ranges, "ingest=mine"])
    assert config.ingest.csv["columns"]["gyro_z"]["counts_per_unit"] == 65.5


@pytest.mark.parametrize("delimiter", [",", ";"])
def test_a_temperature_called_t_beside_times_in_ms_is_no_time(tmp_path: Path, delimiter: str) -> None:
    """A log of a turntable: counts, noisy degC in T, the shaft in hundredths of a degree, 4096 a g, 65.5 a deg/s."""
    rng = np.random.default_rng(3)
    time_s = np.arange(2000) * 0.01 + 920.0
    angle = 15.0 * (1.0 - np.cos(time_s))
    rate = 15.0 * np.sin(time_s)
    force = np.column_stack([np.zeros(2000), np.sin(np.radians(angle)), np.cos(np.radians(angle))])
    temperature = 32.5 + rng.normal(0.0, 0.03, 2000)
    log = np.column_stack([
        time_s * 1e3, np.rint(force * 4096 + rng.normal(0, 8, (2000, 3))),
        np.rint(rate * 65.5), rng.integers(-3, 4, (2000, 2)), temperature, np.rint(angle * 100),
    ])  # fmt: skip
    file = tmp_path / "log.csv"
    header = delimiter.join(["ms", "ax_lsb", "ay_lsb", "az_lsb", "gx_lsb", "gy_lsb", "gz_lsb", "T", "shaft_cdeg"])
    np.savetxt(file, log, ["%.3f", *["%d"] * 6, "%.2f", "%d"], delimiter, header=header, comments="")
    proposal = proposed(file)
    assert proposal.complete, proposal.evidence
    (columns,) = proposal.columns
    assert proposal.csv["delimiter"] == delimiter
    assert columns["time"] == {"column": "ms", "unit": "ms"}
    assert columns["temperature"] == {"column": "T", "unit": "degC", "optional": True}
    assert (columns["accel_x"]["counts_per_unit"], columns["gyro_z"]["counts_per_unit"]) == (4096.0, 65.5)
    table = read_csv([file], csv_formats(proposal.profile("mine")))
    np.testing.assert_allclose(table.time_ns, time_s * 1e9, rtol=0, atol=1000)
    np.testing.assert_allclose(table.values["table_angle"], angle, rtol=0, atol=0.006)
    np.testing.assert_allclose(table.values["gyro_x"], rate, rtol=0, atol=0.008)


def test_times_that_most_rows_share_with_the_row_before_are_proposed() -> None:
    """Whole ms at 4 kHz: the median interval is zero."""
    text = "t_ms,ax,ay,az\n" + "".join(f"{i // 4},0.01,0.02,0.99\n" for i in range(4000))
    (proposal,) = propose([find_layout(text.encode(), "log.csv")])
    assert proposal.columns[0]["time"] == {"column": "t_ms", "unit": "ms"}
    assert proposal.columns[0]["accel_x"]["unit"] == "g"


def test_units_of_samples_in_bursts_are_found_by_their_regular_clock(tmp_path: Path) -> None:
    data = motion().copy()
    data[:, 0] = 0.08 * np.floor(data[:, 0] / 0.08 + 1e-6)  # eight rows of one time
    file = tmp_path / "log.csv"
    np.savetxt(file, data, "%.6g", ",", header="t,ax,ay,az,gx,gy,gz", comments="")
    proposal = proposed(file)
    assert proposal.complete, proposal.evidence
    assert proposal.columns[0]["gyro_x"]["unit"] == "deg/s"
    assert "rows in bursts" in proposal.evidence["time"]
    table = read_csv([file], csv_formats(proposal.profile("mine")))
    assert [n.code for n in table.notes] == ["N-BURSTS"]
    assert np.diff(table.time_ns) == pytest.approx(np.full(len(data) - 1, 1e7), rel=1e-3)


def test_a_log_without_known_names_gives_a_template() -> None:
    text = "t_us,p,q,r,s\n" + "".join(f"{10_000 * i},1,2,{i % 3},4\n" for i in range(100))
    (proposal,) = propose([find_layout(text.encode(), "log.csv")])
    assert proposal.unknown() == [f"{s}_{a}" for s in ("accel", "gyro") for a in "xyz"]
    written = yaml.safe_load(proposal.text("mine"))["csv"]["columns"]
    assert written["accel_x"] == {"column": "???", "unit": "???"}


def test_a_counter_without_a_gap_goes_before_times_of_arrival_that_scatter() -> None:
    """Rows of 99 Hz that arrive in bursts of ten, 2 ms apart."""
    n = np.arange(500)
    arrival = 10.0 * (n // 10) / 99.0 + 0.002 * (n % 10)
    head, rows = "seq,t_s,ax,ay,az\n", zip(n, arrival, strict=True)
    counted = head + "".join(f"{i},{t:.6f},0,0,1.0\n" for i, t in rows)
    (proposal,) = propose([find_layout(counted.encode(), "log.csv")])
    entry = proposal.columns[0]["time"]
    assert (entry["column"], entry["unit"]) == ("seq", "counts")
    assert entry["counts_per_unit"] == pytest.approx(99.0, rel=0.02)
    gap = head + "".join(f"{i + (i > 250)},{t:.6f},0,0,1.0\n" for i, t in zip(n, arrival, strict=True))
    (proposal,) = propose([find_layout(gap.encode(), "log.csv")])
    assert proposal.columns[0]["time"]["column"] == "t_s"
    assert "500 Hz by the median interval and 100.5 Hz on average" in proposal.evidence["time"]


def test_several_triads_of_one_sensor_are_told() -> None:
    head = "t,acc_x,acc_y,acc_z,acc_lp_x,acc_lp_y,acc_lp_z\n"
    text = head + "".join(f"{0.01 * i:.2f},0,0,1.0,0.1,0,1.0\n" for i in range(100))
    (proposal,) = propose([find_layout(text.encode(), "log.csv")])
    assert proposal.columns[0]["accel_x"]["column"] == "acc_x"
    told = "2 triads may be the accelerometer: taken acc_x, acc_y, acc_z; the others are acc_lp_x, acc_lp_y, acc_lp_z"
    assert any(told in remark for remark in proposal.remarks)


def test_a_matlab_file_of_hdf5_is_named(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    file.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512, b"\0") + b"\x89HDF\r\n\x1a\n")
    with pytest.raises(IngestError, match="a MATLAB file: give it the suffix"):
        read_csv(
            [file],
            csv_formats(
                ingest_of(
                    {
                        "csv": {
                            "rate_hz": 1.0,
                            "columns": {c: {"column": c, "unit": "g"} for c in ("accel_x", "accel_y", "accel_z")},
                        }
                    }
                )
            ),
        )


@pytest.mark.parametrize(
    ("scale", "entry"),
    [
        (16.4, {"unit": "counts", "counts_per_unit": 16.4}),
        (70.0, {"unit": "counts", "counts_per_unit": 69.8}),
        (1.0, {"unit": "deg/s"}),
        (np.pi / 180.0, {"unit": "rad/s"}),
    ],
)
def test_the_rate_of_the_table_in_the_same_rows_tells_the_unit_of_the_gyroscope(
    scale: float, entry: dict[str, Any]
) -> None:
    rng = np.random.default_rng(2)
    rate = np.repeat([0.0, 50.0, 0.0, -100.0, 0.0], 100)
    readings = 0.997 * scale * np.outer(rate, [0.02, 0.999, -0.03]) + scale * rng.normal(0.5, 0.1, (500, 3))
    shown = np.round(readings) if entry["unit"] == "counts" else readings
    rows = "".join(f"{0.01 * i:.2f},{r:g},{x:.6g},{y:.6g},{z:.6g}\n" for i, (r, (x, y, z)) in enumerate(
        zip(rate, shown, strict=True)
    ))  # fmt: skip
    (proposal,) = propose([find_layout(f"t,table_rate_dps,gx,gy,gz\n{rows}".encode(), "log.csv")])
    assert {k: proposal.columns[0]["gyro_y"].get(k) for k in entry} == entry, proposal.evidence
    assert "a deg/s of the table's rate in the same rows" in proposal.evidence["gyroscope"]


@pytest.mark.parametrize("turn", [4096, 4000])
def test_an_encoder_that_starts_again_and_turns_about_one_axis_are_read_in_one_profile(
    tmp_path: Path, turn: int
) -> None:
    time = np.arange(2000) * 0.04
    rate = np.where((time % 5.0 > 1.0) & (time % 5.0 < 3.0), 15.0, 0.0)  # deg/s, with rests; counted left-handed
    angle = np.cumsum(rate) * 0.04
    force = np.column_stack([np.full(2000, 0.03), np.sin(np.radians(angle)), np.cos(np.radians(angle)) + 0.05])
    rates = np.column_stack([rate + 1.2, np.full(2000, -0.8), np.full(2000, 0.5)])
    counts = np.mod(np.rint(700 - angle / 360 * turn), turn)
    columns = np.column_stack([3e6 + time * 1e6, counts, np.rint(rates * 1000), np.rint(force * 16384)]).astype(int)
    names = ["usec", "enc", "gx", "gy", "gz", "ax", "ay", "az"]
    for name, kept, separator in (("turn", names, "\t"), ("flight", [n for n in names if n != "enc"], ";")):
        lines = [kept, *([str(row[names.index(n)]) for n in kept] for row in columns)]
        (tmp_path / f"{name}.txt").write_text("\n".join(map(separator.join, lines)) + "\n")
    for order in (("turn", "flight"), ("flight", "turn")):
        proposal = proposed(*(tmp_path / f"{name}.txt" for name in order))
        found = proposal.columns[0]
        assert proposal.csv["delimiter"] == "auto"
        assert found["time"]["unit"] == "us"
        assert found["accel_x"] == {"column": "ax", "unit": "counts", "counts_per_unit": 16384.0}
        assert found["table_angle"]["counts_per_unit"] == pytest.approx(turn / 360)
        assert found["gyro_z"]["counts_per_unit"] == 1000.0


@pytest.mark.parametrize("counts", [57.1429, 114.2857, 131.0, 200.0])
def test_factors_of_a_gyroscope_are_those_of_a_known_sensor_or_the_fitted_one(tmp_path: Path, counts: float) -> None:
    data = motion() * [1, *[16384.0] * 3, *[counts] * 3]
    file = tmp_path / "log.csv"
    np.savetxt(
        file,
        np.column_stack([data[:, 0], np.rint(data[:, 1:])]),
        "%.9g",
        ",",
        header="t,ax,ay,az,gx,gy,gz",
        comments="",
    )
    found = proposed(file).columns[0]["gyro_x"]["counts_per_unit"]
    assert found == pytest.approx(counts, rel=0.05)  # 200: of no sensor that is shipped
    assert found == counts or counts == 200.0  # noqa: PLR1714  (two numbers)
