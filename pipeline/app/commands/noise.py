"""Identify the noise of a unit from a log at rest: white noise N, bias instability B, random walk K and more."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from pipeline.app.commands import parser_of
from pipeline.app.commands.readings import Reading, config_of_log
from pipeline.core.errors import ConfigurationError
from pipeline.core.files import JSON, json_text, write_atomically
from pipeline.core.records import AXES, SENSORS
from pipeline.estimation.noise_identification import identify_noise
from pipeline.output.exports import ExportedUnit, export, formats
from pipeline.output.exports.sensors import SensorFigures
from pipeline.output.pages.held_out_section import remarks, term_rows
from pipeline.output.pages.pages import MINUS, aligned, number

EPILOG = """\
The unit must rest during the whole log. The slow terms need hours; for a term that needs a longer log, an upper limit
(<) is printed. -o writes the file of another program, chosen by its name (kalibr_imu.yaml, vins.yaml), or all results
as .json.

examples:
  python -m pipeline noise static.csv
  python -m pipeline noise static.mcap --sensor mpu6050 -o kalibr_imu.yaml
  python -m pipeline noise static.bag -o noise.json
"""


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline noise LOG``."""
    parser = parser_of("noise", __doc__, EPILOG, ("--ingest", "--sensor"))
    parser.add_argument("log", type=Path, metavar="LOG", help="a log of the unit at rest")
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help="file to write, in the format of its name")
    arguments = parser.parse_args(argv)
    target: Path | None = arguments.output
    consumers = [name for name, (declared, _) in formats().items() if declared.noise and not declared.units]
    if target is not None and target.name not in consumers and target.suffix != ".json":
        listed = ", ".join([*consumers, "a name that ends in .json"])
        raise ConfigurationError(f"-o is {target.name}, which is no format of noise; expected {listed}")
    log: Path = arguments.log
    config = config_of_log(log, arguments.ingest, arguments.sensor)
    sensor_model = config.sensor if arguments.sensor else None
    recording = Reading.alone([log], config.ingest, sensor_model, role="static").checked()
    noise = identify_noise([recording])
    print("\n\n".join(_table_of(sensor, noise[sensor]) for sensor in SENSORS).replace(MINUS, "-"))
    if target is None:
        return 0
    document = {"unit": log.stem, "sensor": arguments.sensor, "noise": noise}
    document["inputs"] = [{"rate_hz": round(1.0 / recording.interval, 6)}]
    text = json_text(noise)
    if target.suffix != ".json":
        sheets = {s: SensorFigures.of(sensor_model.of(s)) for s in SENSORS} if sensor_model else {}
        identified = {s: any(axis["terms"] for axis in (noise[s]["axes"] or {}).values()) for s in SENSORS}
        missing = [s for s in SENSORS if not identified[s] and s not in sheets]
        if missing:
            raise ConfigurationError(f"the log holds no noise of the {' and '.join(missing)}: state --sensor", str(log))
        (text,) = export(target.name, ExportedUnit(document, sheets)).values()
    write_atomically(target, text)
    print(f"written: {target}", file=sys.stderr)
    return 0


def _table_of(sensor: str, noise: JSON) -> str:
    lines = [sensor]
    if noise["source"]:
        lines[0] += f": {noise['samples']} samples, {number(noise['length_s'])} s without a gap"
    rows = [["", *AXES, "unit"], *([r["name"], *r["axes"], r["unit"]] for r in term_rows(noise))]
    lines += aligned(rows) if len(rows) > 1 else []
    return "\n".join([*lines, *(f"  {line}" for line in remarks(noise))])
