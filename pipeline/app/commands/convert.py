"""Convert a calibration into the format of another program, and state what is lost."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from imu_logs.yaml_file import read_yaml
from pipeline.app.commands import parser_of
from pipeline.app.config.options import LARGEST_CONFIG
from pipeline.core.errors import ConfigurationError
from pipeline.core.files import CONFIGS
from pipeline.core.records import SENSORS
from pipeline.output.exports import formats
from pipeline.output.exports.reading import CALIBRATION, ImportedCalibration, convert, counts_of, format_of, read_any
from pipeline.output.exports.sensors import SensorFigures

EPILOG = """\
The format of IN follows from its name and content, the format of OUT from its name: kalibr.yaml, px4.params,
calibration.json ... The written file is read back and compared with IN; the command prints what is lost. Formats in
counts, and formats with noise densities, need --sensor if IN does not name the sensor.

examples:
  python -m pipeline convert results/demo/calibrations/mpu6050-1.json px4.params
  python -m pipeline convert my_kalibr.yaml calibration.json
  python -m pipeline convert rig_acc.calib out/d435i.json --to realsense
  python -m pipeline convert inav.txt kalibr.yaml --sensor mpu6050
"""


def main(argv: Sequence[str]) -> int:
    """Run ``python -m pipeline convert IN OUT``."""
    names = textwrap.fill(f"formats: {', '.join([CALIBRATION, *formats()])}", 118)
    parser = parser_of("convert", __doc__, f"{EPILOG}\n{names}\n", ("--sensor",))
    add = parser.add_argument
    add("source", type=Path, metavar="IN", help="a calibration in any of the formats")
    add("target", type=Path, metavar="OUT", help="the file to write")
    add("--from", dest="source_format", metavar="FORMAT", help="format of IN, if name and content are ambiguous")
    add("--to", dest="target_format", metavar="FORMAT", help="format of OUT, if it differs from the name")
    arguments = parser.parse_intermixed_args(argv)
    imported = read_any(arguments.source, arguments.source_format, counts_of(sensor_figures(arguments.sensor)))
    sheets = sensor_figures(arguments.sensor, imported)
    format_name = format_of(arguments.target.name if arguments.target_format is None else arguments.target_format)
    if arguments.target.exists() and arguments.source.exists() and arguments.target.samefile(arguments.source):
        raise ConfigurationError("OUT is the file IN: choose another name", str(arguments.target))
    files, lost = convert(imported, format_name, arguments.target, sheets)
    print(f"{arguments.source} ({imported.format_name}): {' and '.join(imported.sensors)}")
    for note in imported.notes:
        print(f"  {note}")
    print(f"written: {', '.join(map(str, files))}")
    print("lost: nothing" if not lost else "lost:")
    for line in lost:
        print(f"  {line}")
    if format_name == CALIBRATION and imported.document is None:
        stated = [s for s, c in imported.sensors.items() if c.covariance is not None]
        known = f"that of the bias of the {' and the '.join(stated)} alone" if stated else "none"
        print(f"uncertainty: {known} is known; the others are null")
    return 0


def sensor_figures(sensor: str | None, imported: ImportedCalibration | None = None) -> dict[str, SensorFigures]:
    """Return what a sensor's file states, named by ``sensor`` or by the calibration; empty if neither names one."""
    name = sensor or (imported.document or {}).get("sensor") if imported else sensor
    file = CONFIGS / "sensor" / f"{name}.yaml"
    if name is None or (sensor is None and not file.is_file()):
        return {}
    if not file.is_file():
        known = ", ".join(sorted(path.stem for path in file.parent.glob("*.yaml")))
        raise ConfigurationError(f"--sensor {name}: no such sensor; known: {known}")
    content = read_yaml(file, LARGEST_CONFIG)
    keys = [key.name for key in fields(SensorFigures)]
    return {s: SensorFigures(**{key: content[s].get(key) for key in keys}) for s in SENSORS if content.get(s)}
