"""The microcontroller example compiles without warnings and gives what apply gives, across a wrap of its timer."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from test_c_header import document, needs_compiler

from pipeline import load_calibration
from pipeline.core.files import write_json
from pipeline.output.exports import ExportedUnit, export

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "imu_loop.c"
EFFECTS = {"accelerometer": {"bias_temperature": 1e-3}, "gyroscope": {"bias_temperature": 0.1, "g_sensitivity": 0.05}}
BOARD = """
#include <stdio.h>
#include "imu_loop.c"
int read_sensor(raw_sample *s)
{
    return scanf("%hd %hd %hd %hd %hd %hd %f %u", s->force, s->force + 1, s->force + 2, s->rate, s->rate + 1,
                 s->rate + 2, &s->temperature_degc, &s->time_us) == 8;
}
void use(const imu_real f[3], const imu_real w[3], double time_s)
{
    printf("%.9g %.17g %.17g %.17g %.17g %.17g %.17g\\n", time_s, (double)f[0], (double)f[1], (double)f[2],
           (double)w[0], (double)w[1], (double)w[2]);
}
int main(void)
{
    imu_loop();
    return 0;
}
"""


@needs_compiler
@pytest.mark.parametrize(("real", "tolerance"), [("double", 1e-9), ("float", 2e-6)])
def test_the_example_gives_what_apply_gives(tmp_path: Path, real: str, tolerance: float) -> None:
    made = document(EFFECTS)
    write_json(tmp_path / "U1.json", made)
    (tmp_path / "calibration.h").write_text(export("calibration.h", ExportedUnit(made, {}))["calibration.h"])
    (tmp_path / "board.c").write_text(BOARD)
    flags = [
        "-std=c99",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-pedantic",
        "-O2",
        f"-DIMU_REAL={real}",
        f"-I{EXAMPLE.parent}",
        "-I.",
    ]
    subprocess.run(["cc", *flags, "board.c", "-o", "board", "-lm"], cwd=tmp_path, check=True)
    rng, n = np.random.default_rng(5), 500
    counts = rng.integers(-20000, 20000, (n, 6))
    warmth, time = 30.0 + 0.25 * np.arange(n) / 50, 2000 * np.arange(n)
    stamps = (2**32 - 300_000 + time) % 2**32
    rows = [[*c, f"{t:.9g}", s] for c, t, s in zip(counts.tolist(), warmth.astype(np.float32), stamps, strict=True)]
    text = "\n".join(" ".join(map(str, row)) for row in rows)
    done = subprocess.run([tmp_path / "board"], input=text, capture_output=True, text=True, check=True)
    found = np.array([line.split() for line in done.stdout.splitlines()], float)
    np.testing.assert_allclose(found[:, 0], time / 1e6, atol=1e-9)
    assert stamps.argmin() > 0  # the timer wraps
    force, rate = counts[:, :3] / 16384.0, counts[:, 3:] / 131.0
    out = load_calibration(tmp_path / "U1.json").apply(force, rate, warmth.astype(np.float32), time / 1e6)
    np.testing.assert_allclose(found[:, 1:4], out.accelerometer, atol=tolerance * 2.0)
    np.testing.assert_allclose(found[:, 4:], out.gyroscope, atol=tolerance * 250.0)
