"""A sound log and the 44 ways in which it is spoilt, as they are numbered in ``docs/bad_inputs.md``."""

from __future__ import annotations

import copy
import gzip
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from sample_logs import profile

if TYPE_CHECKING:
    from collections.abc import Callable

HEADER = "time_s,accel_x_g,accel_y_g,accel_z_g,gyro_x_dps,gyro_y_dps,gyro_z_dps"
SAMPLES = 3000
INTERVAL_S = 0.01
FILE = "log.csv"


def readings() -> np.ndarray:
    """Return time (s), specific force (g) and rate (deg/s) of rests and quarter turns about x: (3000, 7) array."""
    generator = np.random.default_rng(3)
    time = INTERVAL_S * np.arange(SAMPLES)
    rate = np.where(np.arange(SAMPLES) % 500 >= 400, 90.0, 0.0)
    angle = np.radians(np.concatenate([[0.0], np.cumsum(rate[:-1]) * INTERVAL_S]))
    force = np.stack([0 * angle, np.sin(angle), np.cos(angle)], axis=1) + 1e-3 * generator.normal(size=(SAMPLES, 3))
    gyro = np.stack([rate, 0 * rate, 0 * rate], axis=1) + 0.05 * generator.normal(size=(SAMPLES, 3))
    return np.column_stack([time, np.round(force, 5), np.round(gyro, 4)])


VALUES = readings()


def rows_of(values: np.ndarray) -> list[str]:
    """Return rows as text that gives the same doubles."""
    return [f"{row[0]:.2f}," + ",".join(repr(v) for v in row[1:]) for row in values.tolist()]


ROWS = rows_of(VALUES)


def text(rows: list[str] = ROWS, header: str = HEADER) -> bytes:
    return ("\n".join([header, *rows]) + "\n").encode()


@dataclass
class Case:
    """One bad input and what has to come of it.

    ``fault`` of a refusal, else ``notes`` and the ``kept`` rows of the sound log that have to be read, bit for bit.
    """

    files: dict[str, bytes]
    fault: str = ""
    says: str = ""
    line: int = 0
    notes: tuple[str, ...] = ()
    kept: Any = None
    settings: dict[str, Any] = field(default_factory=dict)
    flags: dict[int, int] = field(default_factory=dict)
    procedure: Callable[[dict[str, Any]], None] | None = None

    def ingest(self) -> dict[str, Any]:
        """Return the canonical profile with the case's settings, given as ``section/key/...``."""
        ingest = copy.deepcopy(profile("canonical_csv"))
        for path, value in self.settings.items():
            *steps, last = path.split("/")
            node = ingest
            for step in steps:
                node = node.setdefault(step, {})
            node[last] = value
        return ingest


ALL = np.arange(SAMPLES)


def refused(content: bytes, fault: str, says: str, *, line: int = 0, settings: dict[str, Any] | None = None) -> Case:
    return Case({FILE: content}, fault, says, line, settings=settings or {})


def read(content: bytes, *notes: str, kept: Any = ALL, **expected: Any) -> Case:
    return Case({FILE: content}, notes=notes, kept=kept, **expected)


# As git-lfs writes it (docs/spec.md of git-lfs, "The Pointer").
LFS_POINTER = (
    b"version https://git-lfs.github.com/spec/v1\n"
    b"oid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393\nsize 12345\n"
)


def without(*rows: int) -> np.ndarray:
    return np.setdiff1d(np.arange(SAMPLES), rows)


def changed(row: int, line: str) -> bytes:
    rows = list(ROWS)
    rows[row] = line
    return text(rows)


def cell(value: str) -> bytes:
    """Return the log with another text for accel_y_g in the sixth row."""
    cells = ROWS[5].split(",")
    cells[2] = value
    return changed(5, ",".join(cells))


def table(values: np.ndarray, **columns: np.ndarray) -> bytes:
    """Return a log of other values, with further columns."""
    rows = [r + "".join(f",{float(c[i])!r}" for c in columns.values()) for i, r in enumerate(rows_of(values))]
    return text(rows, ",".join([HEADER, *columns]))


def times(cells: list[str]) -> bytes:
    return text([c + "," + r.partition(",")[2] for c, r in zip(cells, ROWS, strict=True)])


def two_logs() -> bytes:
    """Return the rows of two sensors with one clock, in turn; their biases differ by 1 mg, as their noise."""
    other = np.where(np.arange(SAMPLES) % 2 == 1, 1e-3, 0.0)[:, None] * np.array([0, 1, 0, 0, 0, 0, 0])
    rows = rows_of(VALUES + other)
    return text([f"{0.02 * (i // 2):.2f},{row.partition(',')[2]}" for i, row in enumerate(rows)])


RATE = np.round(VALUES[:, 4])
TABLE_ANGLE = np.concatenate([[0.0], np.cumsum(RATE[1:] + RATE[:-1]) / 2 * INTERVAL_S])
DROP = {"csv/bad_rows": "drop"}
CANONICAL_COLUMNS = dict(
    zip(HEADER.split(","), ("time", *(f"{s}_{a}" for s in ("accel", "gyro") for a in "xyz")), strict=True)
)


def gcsv() -> bytes:
    """Return the log as Gyroflow writes it, its numbers with a scale of 1 g and of 1 deg/s."""
    head = ["GYROFLOW IMU LOG", "version,1.3", "orientation,XYZ", "tscale,1", f"gscale,{np.pi / 180!r}", "ascale,1"]
    return text(ROWS, "\n".join([*head, "t,ax,ay,az,gx,gy,gz"]))


def indexed() -> dict[str, Any]:
    """Return the column map of a file without header."""
    units = ["s", *["g"] * 3, *["deg/s"] * 3]
    names = CANONICAL_COLUMNS.values()
    return {n: {"column": i, "unit": u} for i, (n, u) in enumerate(zip(names, units, strict=True))}


def edited(rows: slice, columns: int | slice, value: float | np.ndarray) -> bytes:
    values = VALUES.copy()
    values[rows, columns] = value
    return text(rows_of(values))


def stuck(last: int) -> bytes:
    return edited(slice(1000, last), 5, VALUES[1000, 5])


def scaled(columns: slice, factor: float) -> bytes:
    return edited(slice(None), columns, factor * VALUES[:, columns])


def with_table_axis(order: tuple[int, int, int], sign: float = 1.0) -> bytes:
    values = VALUES.copy()
    values[:, 4:7] = sign * values[:, 4:7][:, order]
    return table(values, table_rate_dps=RATE)


def with_angle(angle: np.ndarray, rate: np.ndarray, *, mirrored: str = "", upright: bool = False) -> bytes:
    """Return the turn about x with a table log, an axis of the accelerometer mirrored, or about a vertical axis."""
    values = VALUES.copy()
    if mirrored:
        values[:, 1 + "xyz".index(mirrored)] *= -1.0
    if upright:
        values[:, 1:4] = [1.0, 0.0, 0.0]
    return table(values, table_angle_deg=angle, table_rate_dps=rate)


def table_log(offset_s: float, drift: float) -> bytes:
    """Return the log of a table whose clock is ahead by an offset and gains."""
    own = np.arange(-200, SAMPLES + 200) * INTERVAL_S
    lines = [
        f"{(t * (1 + drift) + offset_s):.7f},{a:.6f}"
        for t, a in zip(own, np.interp(own, VALUES[:, 0], TABLE_ANGLE), strict=True)
    ]
    return ("\n".join(["tau_s,angle_deg", *lines]) + "\n").encode()


def cases() -> dict[str, Case]:
    whole = text()
    micro = 2**32 - 12_345_678
    wrapping = [str((micro + 10_000 * i) % 2**32) for i in range(SAMPLES)]
    sprinkled = text([r if i % 100 else "x" for i, r in enumerate(ROWS)])
    nul_row = changed(5, "0.05" + "\0" * 64)
    with_preamble, with_comment = b"Fs,100\nmode,0\n" + whole, b"# made by hand\n" + whole
    header_again = text([*ROWS[:1500], HEADER, *ROWS[:1500]])
    from_earlier = text([*ROWS[:1500], *ROWS[200:1000]])
    rebooted = text([*ROWS[:1500], "rst cause:2", "boot", *ROWS[200:1000]])
    decimal_commas = whole.replace(b",", b";").replace(b".", b",")
    unix = [f"{1.7e18 + 5000.0 * i:.17g}" for i in range(SAMPLES)]
    out = {
        "01": Case({}, "unreadable", "is a directory"),
        "01 missing": Case({}, "missing_file", "missing recordings: log"),
        "02": refused(b"", "empty", r"the file is empty \(0 bytes\)"),
        "03": refused(text([]), "no_rows", "header on line 1, 0 data rows"),
        "04 gzip": refused(gzip.compress(whole), "foreign", "a gzip file: decompress it first"),
        "04 excel": refused(b"PK\x03\x04" + whole, "foreign", "a zip or Excel file"),
        "04 mcap": refused(b"\x89MCAP0\r\n", "foreign", "give it the suffix .mcap"),
        "04 sqlite": refused(b"SQLite format 3\0" + whole, "foreign", "give a ROS 2 bag the suffix .db3"),
        **{
            f"04 pointer{suffix}": Case(
                {f"log{suffix}": LFS_POINTER}, fault="git_lfs", says="is a Git LFS pointer, .* run git lfs pull"
            )
            for suffix in (".csv", ".gcsv", ".mcap", ".bag", ".db3", ".ulg", ".bin", ".h5", ".mat")
        },
        "05": read(b"\xef\xbb\xbf" + whole, "N-BOM"),
        "06": refused(text().decode().encode("utf-16"), "utf16", "UTF-16 text: save it as UTF-8"),
        "06 without mark": refused(text().decode().encode("utf-16-le"), "utf16", "UTF-16 text"),
        "07 mixed": read(whole.replace(b"\n", b"\r\n", 40), "N-EOL"),
        "07 CR": read(whole.replace(b"\n", b"\r"), "N-EOL"),
        "07 inside a number": refused(whole.replace(b"0.", b"0\r.", 1), "bad_row", "a carriage return inside"),
        "07 some lines": read(whole.replace(b"\n", b"\r", 40), "N-EOL"),
        "07 CRLF": read(whole.replace(b"\n", b"\r\n"), "N-EOL"),
        "08": read(whole[:-1], "N-TAIL", kept=without(SAMPLES - 1)),
        "08 in a number": read(whole[:-5], "N-TAIL", kept=without(SAMPLES - 1)),
        "09": read(changed(SAMPLES - 1, "29.99,0.1"), "N-TAIL", kept=without(SAMPLES - 1)),
        "10 short": refused(changed(5, "0.05,0.1"), "bad_row", "has 2 fields where 7 are expected", line=7),
        "10 many": refused(
            sprinkled,
            "bad_row",
            r"has 1 fields where 7 are expected: 'x' \(29 more such lines, up to line 2902: 102, 202, 302, 402 ",
            line=2,
        ),
        "10 drop": read(changed(5, "0.05,0.1"), "N-BADROW", "N-GAP", kept=without(5), settings=DROP, flags={5: 1}),
        "10 line break in a number": read(
            changed(5, ROWS[5][:-2] + "\n" + ROWS[5][-2:]), "N-BADROW", "N-GAP", kept=without(5), settings=DROP
        ),
        "10 over budget": refused(
            sprinkled,
            "bad_row",
            "30 of 3000 rows would have to be repaired, more than the share of 0.001",
            line=2,
            settings=DROP,
        ),
        "11": refused(changed(5, ROWS[5] + ROWS[6]), "bad_row", "has 13 fields where 7 are expected", line=7),
        "11 drop": read(
            text([*ROWS[:5], ROWS[5] + ROWS[6], *ROWS[7:]]), "N-BADROW", "N-GAP", kept=without(5, 6), settings=DROP
        ),
        "12": refused(nul_row, "nul", "64 NUL bytes, the first at byte", line=7),
        "12 drop": read(nul_row, "N-BADROW", "N-GAP", kept=without(5), settings=DROP),
        "13": read(whole + bytes(4096), "N-NULTAIL"),
        "14": refused(with_preamble, "missing_column", "line 3 holds them: set ingest.csv.skip_lines", line=1),
        "14 profile": read(with_preamble, settings={"csv/skip_lines": 2}),
        "14 gcsv": Case({"log.gcsv": gcsv()}, kept=ALL),
        "15": refused(with_comment, "missing_column", "found # made by hand", line=1),
        "15 profile": read(with_comment, "N-COMMENT", settings={"csv/comment": "#"}),
        "15 header": read(b"# " + whole, "N-COMMENT", settings={"csv/comment": "#", "csv/header": "commented"}),
        "16": refused(text(ROWS[1:], ROWS[0]), "no_header", "set ingest.csv.header=false", line=1),
        "16 indexed": read(whole.partition(b"\n")[2], settings={"csv/header": False, "csv/columns": indexed()}),
        "17": refused(header_again, "restarted", "by its key session", line=1502),
        "17 session": read(header_again, "N-SESSION", kept=ALL[:1500], settings={"csv/session": 2}),
        "18": refused(
            whole.replace(b"gyro_y", b"gyro_x"), "duplicate_column", "gyro_x_dps occurs more than once", line=1
        ),
        "19": refused(whole.replace(b"gyro_z_dps", b"gyro_z_dsp"), "missing_column", "nearest: gyro_z_dsp", line=1),
        "19 ignored": read(table(VALUES, mag_x=RATE), "N-IGNORED"),
        "20": read(
            text(
                [",".join(r.split(",")[i] for i in (6, 5, 4, 3, 2, 1, 0)) for r in ROWS],
                ",".join(HEADER.split(",")[::-1]),
            ),
            "N-ORDER",
        ),
        "21": refused(decimal_commas, "decimal_comma", "a decimal comma", line=2, settings={"csv/delimiter": ";"}),
        "21 profile": read(decimal_commas, settings={"csv/delimiter": ";", "csv/decimal": ","}),
        "22": refused(whole.replace(b",", b";"), "missing_column", "is the separator ';'", line=1),
        "22 auto": read(whole.replace(b",", b"\t"), "N-DELIM", settings={"csv/delimiter": "auto"}),
        "23": refused(cell("ERR"), "not_a_number", r"column accel_y_g \(accel_y\) is 'ERR'", line=7),
        "23 drop": read(cell("ERR"), "N-BADROW", "N-GAP", kept=without(5), settings=DROP),
        "24 empty": refused(cell(""), "not_finite", r"accel_y_g \(accel_y\) is empty", line=7),
        "24 NaN": refused(cell("NaN"), "not_finite", "is 'NaN'; a finite number is expected", line=7),
        "24 infinite": refused(cell("-inf"), "not_finite", "is '-inf'; a finite number", line=7),
        "24 too large": refused(cell("1e400"), "not_finite", "more than a number can hold", line=7),
        "24 gap": read(cell("NaN"), "N-NAN", "N-GAP", kept=without(5), settings={"csv/nan": "gap"}),
        "25 hexadecimal": refused(cell("0x1F"), "not_a_number", "is '0x1F'", line=7),
        "25 thousands": refused(cell('"1,000.5"'), "not_a_number", "is '1,000.5'", line=7),
        "25 quotes": refused(cell('"0.5"'), "not_a_number", "is '\"0.5\"', in quotes", line=7),
        "25 minus": refused(cell("\u22120.5"), "not_a_number", "is '\u22120.5'", line=7),
        "26": refused(
            whole,
            "bad_configuration",
            "accel_x.unit is None; allowed are g",
            settings={"csv/columns/accel_x/unit": None},
        ),
        "26 unknown": refused(
            whole, "bad_configuration", "unit is 'm/s2'", settings={"csv/columns/accel_x/unit": "m/s2"}
        ),
        "27": refused(
            whole.replace(b"accel_x_g", b"ax [m/s^2]"),
            "unit_contradiction",
            r"'ax \[m/s\^2\]' is in m/s\^2, ingest.csv.columns.accel_x.unit says g",
            line=1,
            settings={"csv/columns/accel_x/column": "ax [m/s^2]"},
        ),
        "28 counts": refused(scaled(slice(1, 4), 16384.0), "implausible_force", "look like raw counts"),
        "28 m/s^2": refused(scaled(slice(1, 4), 9.80665), "implausible_force", r"look like m/s\^2"),
        "28 rad/s": refused(
            scaled(slice(4, 7), np.pi / 180), "implausible_rate", "look like rad/s that were declared as deg/s"
        ),
        "28 full-scale range": refused(
            scaled(slice(4, 7), 0.5),
            "implausible_rate",
            "multiplied by 2 .* another full-scale range than declared, or the times are wrong",
        ),
        "28 rad/s by the table": refused(
            table(np.column_stack([VALUES[:, :4], VALUES[:, 4:] * np.pi / 180]), table_rate_dps=RATE),
            "implausible_rate",
            "look like rad/s that were declared as deg/s",
        ),
        "28 full scale": refused(scaled(slice(4, 7), 57.3), "beyond_full_scale", "beyond 1.2 times the full scale"),
        "29": refused(whole.replace(b"time_s,", b"t,"), "missing_column", "column time_s", line=1),
        "29 rate": read(whole, "N-IGNORED", "N-SYNTHTIME", settings={"csv/columns/time": None, "csv/rate_hz": 100.0}),
        "30": refused(
            whole,
            "wrong_rate",
            "the median interval is 10 us, .* expects 10000 us; .* a thousand times longer",
            settings={"csv/columns/time/unit": "ms", "checks/rate_hz": 100.0},
        ),
        "30 by hand": refused(
            whole, "wrong_rate", "if the times are multiplied by 1000 ", settings={"csv/columns/time/unit": "ms"}
        ),
        "31": refused(times(unix), "coarse_time", "256 ns apart", settings={"csv/columns/time/unit": "ns"}),
        "32": read(times(wrapping), "N-WRAP", settings={"csv/columns/time/unit": "us"}),
        "32 milliseconds": read(
            times([str((2**32 - 12_345 + 10 * i) % 2**32) for i in range(SAMPLES)]),
            "N-WRAP",
            settings={"csv/columns/time/unit": "ms"},
        ),
        "32 of 16 bits": read(
            times([str((2**16 - 500 + i) % 2**16) for i in range(SAMPLES)]),
            "N-WRAP",
            settings={"csv/columns/time": {"column": "time_s", "unit": "counts", "counts_per_unit": 100.0}},
        ),
        "33": refused(from_earlier, "time_back", "time goes back to 2 s after 14.99 s", line=1502),
        "33 part of it twice": refused(
            from_earlier,
            "time_back",
            "lines 1502 to 2301 repeat lines 202 to 1001 exactly: delete them; the log has 2 parts, lines 2 to 15",
            line=1502,
        ),
        "33 a block twice": read(text([*ROWS[:1500], *ROWS[1480:]]), "N-REPEAT"),
        "33 a block three times": read(text([*ROWS[:1500], *ROWS[1480:1500], *ROWS[1480:]]), "N-REPEAT", "N-REPEAT"),
        "33 a block twice that differs": refused(
            text([*ROWS[:1500], *ROWS[1480:1499], ROWS[1499] + "9", *ROWS[1500:]]), "time_back", "goes back"
        ),
        "33 session": read(from_earlier, "N-SESSION", kept=ALL[200:1000], settings={"csv/session": 2}),
        "10 and a restart": refused(
            rebooted,
            "bad_row",
            "1 more such lines.*Also line 1504: time goes back.*2 parts, lines 2 to 1501; 1504 to 2303",
            line=1502,
        ),
        "33 session and text": read(rebooted, "N-SESSION", kept=ALL[200:1000], settings={"csv/session": 2}),
        "34": read(text([*ROWS[:700], ROWS[701], ROWS[700], *ROWS[702:]]), "N-SORT", flags={700: 8, 701: 8}),
        "35 same": read(text([*ROWS[:10], *ROWS[9:]]), "N-DUP"),
        "35 different": refused(
            text([*ROWS[:10], ROWS[9][:-1] + "9", *ROWS[10:]]), "duplicate_time", "time repeats 0.09 s", line=12
        ),
        "36": read(text([*ROWS[:600], *ROWS[610:]]), "N-GAP", kept=without(*range(600, 610)), flags={600: 1}),
        "36 too long": refused(
            text([*ROWS[:600], *ROWS[700:]]), "missing_time", "3.334% of the time is missing", line=602
        ),
        "36 bursts": refused(
            times([f"{0.08 * (i // 8) + 0.0002 * (i % 8):.4f}" for i in range(SAMPLES)]),
            "bursts",
            r"bursts of 8, 80 ms apart, with times 0.2 ms apart: .* ingest.csv.columns.time=null and "
            r"ingest.csv.rate_hz=100,",
            line=10,
        ),
        "36 burst lost": refused(
            text([f"{0.08 * (i // 8):.2f},{r.partition(',')[2]}" for i, r in enumerate(ROWS) if i // 8 != 100]),
            "bursts",
            r"bursts of 8, 80 ms apart: they depart from a regular clock .* as if rows were missing; if no row is "
            r"missing, count the rows: ingest.csv.columns.time=null and ingest.csv.rate_hz=100,",
            line=10,
        ),
        "36 rounded": refused(
            times([f"{int(i / 0.833) / 1000:.3f}" for i in range(SAMPLES)]),
            "missing_time",
            r"16.694% of the time is missing; the times are multiples of 1 ms; if they are rounded and no row is "
            r"missing, count the rows: .*ingest.csv.rate_hz=833.056",
        ),
        "35 bursts": read(times([f"{0.08 * (i // 8):.2f}" for i in range(SAMPLES)]), "N-BURSTS"),
        "35 two logs": refused(
            two_logs(), "bursts", "their rows differ as those of two sensors or of two merged logs do", line=4
        ),
        "37": read(times([f"{0.01 * i + 0.004 * ((i * 7) % 3 == 0):.3f}" for i in range(SAMPLES)]), "N-JITTER"),
        "37 too much": read(times([f"{0.01 * i + 0.008 * (i % 2):.3f}" for i in range(SAMPLES)]), "N-JITTER"),
        "38": read(stuck(1100), "N-STUCK", kept=None, flags={1000: 4, 1099: 4}),
        "38 half": refused(stuck(2900), "stuck", "gyro_y stays at one value .* in 1900 of 3000 rows"),
        "38 dead": refused(scaled(slice(6, 7), 0.0), "stuck", "gyro_z is 0 deg/s in all 3000 rows"),
        "39": read(edited(slice(420, 424), 4, 250.0), "N-CLIP", kept=None, flags={420: 2, 423: 2}),
        "40 axis": refused(
            with_table_axis((2, 0, 1)), "wrong_axis", "said to turn about x, and the gyroscope turns about y"
        ),
        "40 sign": refused(with_table_axis((0, 1, 2), -1.0), "wrong_sense", "sign opposite to the table's rate"),
        "40 sense": read(with_angle(-TABLE_ANGLE, -RATE), "N-FOUND"),
        "45": refused(
            with_angle(TABLE_ANGLE + 180.0, RATE),
            "wrong_face",
            r"mounted otherwise than stated, .*set procedure\.recordings\.log\.up=-z",
        ),
        "46": read(with_angle(TABLE_ANGLE + 37.0, RATE), "N-FOUND"),
        "47": refused(
            with_angle(TABLE_ANGLE, RATE, mirrored="y"),
            "mirrored_axes",
            r"gravity turns as in a turn about body -x, and the gyroscope reads a turn about \+x",
        ),
        "48": refused(
            with_angle(TABLE_ANGLE, RATE, upright=True),
            "wrong_face",
            r"the turn axis is vertical, and \+z is stated to point up; .*procedure\.recordings\.log\.up=\+x",
        ),
        "41": Case(
            {FILE: whole, "table.csv": table_log(5.25, 40e-6)},
            notes=("N-SYNC",),
            kept=ALL,
            settings={
                "csv/parts": [
                    {
                        "file": "{file}.csv",
                        "columns": {
                            c: {"column": n, "unit": "s" if c == "time" else "g" if "accel" in c else "deg/s"}
                            for n, c in CANONICAL_COLUMNS.items()
                        },
                    },
                    {
                        "file": "table.csv",
                        "own_clock": True,
                        "columns": {
                            "time": {"column": "tau_s", "unit": "s"},
                            "table_angle": {"column": "angle_deg", "unit": "deg"},
                        },
                    },
                ],
                "csv/columns": {},
            },
        ),
        "41 unlike": Case(
            {FILE: whole, "table.csv": b"tau_s,angle_deg\n" + b"".join(b"%d,%d\n" % (i, i * i) for i in range(60))},
            "no_sync",
            "does not show the motion that the gyroscope read",
        ),
        "43": refused(whole, "changed", "the file changed while it was read"),
        "44": Case(
            {FILE: whole, "other.csv": whole}, "same_file", "recordings log and other are the same file, byte for byte"
        ),
    }
    out["41 unlike"].settings = out["41"].settings
    return out


INPUTS = {  # what each number is; docs/bad_inputs.md lists what happens
    "1": "missing, a folder, not readable",
    "2": "0 bytes",
    "3": "a header and no rows",
    "4": "another format under the name of a text log; a Git LFS pointer",
    "5": "a byte order mark",
    "6": "UTF-16",
    "7": "CRLF, CR or mixed line ends; inside a number",
    "8": "no newline after the last line: the line is dropped",
    "9": "the last line lacks fields: it is dropped",
    "10": "a row with too few or too many fields",
    "11": "two rows in one line",
    "12": "NUL bytes inside",
    "13": "NUL bytes at the end",
    "14": "lines before the header",
    "15": "comments",
    "16": "no header",
    "17": "a repeated header: the logger was restarted",
    "18": "a column's name twice",
    "19": "a column is missing; there is an additional column",
    "20": "axes in another order: taken by name",
    "21": "decimal commas",
    "22": "semicolons or tabs",
    "23": "text for a number",
    "24": "an empty cell, NaN, infinity, 1e400",
    "25": "0x1F, 1,000.5, a dash for a minus sign, numbers in quotes",
    "26": "a unit of the profile is missing or unknown",
    "27": "the header states another unit than the profile",
    "28": "force or rate of another unit or full-scale range; readings beyond 1.2 times full scale",
    "29": "no time column",
    "30": "times of another unit",
    "31": "ns since 1970, stored as doubles",
    "32": "a time counter overflows: it is continued",
    "33": "time goes back; an exact copy of a block of rows is dropped",
    "34": "rows out of order by at most 5 places: sorted",
    "35": "a time twice: of the same row, of another row, of many rows",
    "36": "gaps; more than 1 % of the time",
    "37": "intervals scatter by more than 20 %",
    "38": "an axis stays at one value; for half of the rows",
    "39": "readings at full scale",
    "40": "a turn about another axis, or in the other direction",
    "41": "the table's log has a clock of its own; it differs from the readings",
    "42": "no temperature, or a constant one: its effects are not observable",
    "43": "the file changes while it is read",
    "44": "one file under two names",
    "45": "the opposite face points up in every turn",
    "46": "another zero of the table, by more than 5 deg",
    "47": "a mirrored axis; axes of one sensor exchanged",
    "48": "a turn about a vertical axis that is not stated",
}
