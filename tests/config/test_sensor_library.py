"""The chips that ship: counts and full scales against the scales that drivers state, and the choice of a range."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
import yaml

from pipeline.app.config.compose import Composer
from pipeline.core.errors import ConfigurationError
from pipeline.core.files import CONFIGS
from pipeline.simulation.description import shipped_settings

if TYPE_CHECKING:
    from collections.abc import Callable

    Compose = Callable[..., dict[str, Any]]

G = 9.80665
RAD = 57.29577951308232
FILES = {f.stem: yaml.safe_load(f.read_text()) for f in sorted((CONFIGS / "sensor").glob("*.yaml"))}
INVENSENSE = {2: 598e-6, 4: 1196e-6, 8: 2392e-6, 16: 4785e-6}  # m/s^2, Linux, inv_mpu_core.c: accel_scale
INVENSENSE_GYRO = {250: 133090e-9, 500: 266181e-9, 1000: 532362e-9, 2000: 1064724e-9}  # rad/s, gyro_scale_6050
BOSCH = {2: 598e-6, 4: 1197e-6, 8: 2394e-6, 16: 4788e-6}  # m/s^2, Linux, bmi160_core.c
BOSCH_GYRO = {125: 66.5e-6, 250: 133e-6, 500: 266e-6, 1000: 532e-6, 2000: 1065e-6}  # rad/s, 66 to 0.5 urad/s there
ST = {2: 0.061e-3 * G, 4: 0.122e-3 * G, 8: 0.244e-3 * G, 16: 0.488e-3 * G}  # STMicroelectronics/*-pid, mg
ST_GYRO = {125: 4.375e-3 / RAD, 250: 8.75e-3 / RAD, 500: 17.5e-3 / RAD, 1000: 35e-3 / RAD, 2000: 70e-3 / RAD}
STIM = {5: G / 2**20, 10: G / 2**19, 30: G / 2**18, 80: G / 2**16}  # vortexntnu/stim300-driver
# m/s^2 and rad/s of one count, by range, and the bits of a reading.
DRIVERS: dict[str, tuple[dict[float, float], dict[float, float], int, int]] = {
    "mpu6000": (INVENSENSE, INVENSENSE_GYRO, 16, 16),
    "mpu6050": (INVENSENSE, INVENSENSE_GYRO, 16, 16),
    "mpu6500": (INVENSENSE, INVENSENSE_GYRO, 16, 16),
    "mpu9250": (INVENSENSE, INVENSENSE_GYRO, 16, 16),
    "icm20948": (INVENSENSE, INVENSENSE_GYRO, 16, 16),
    "icm42688": (INVENSENSE, INVENSENSE_GYRO | {r: r / 2**15 / RAD for r in (15.625, 31.25, 62.5, 125)}, 16, 16),
    "lsm6ds3": (ST, {245 if r == 250 else r: s for r, s in ST_GYRO.items()}, 16, 16),
    "lsm6dso": (ST, ST_GYRO, 16, 16),
    "lsm6dsv": (ST, {**ST_GYRO, 4000: 140e-3 / RAD}, 16, 16),
    "lsm9ds1": (ST | {16: 0.732e-3 * G}, {245: ST_GYRO[250], 500: ST_GYRO[500], 2000: ST_GYRO[2000]}, 16, 16),
    "bmi055": ({r: r / 2**11 * G for r in (2, 4, 8, 16)}, BOSCH_GYRO, 12, 16),
    "bmi088": ({r: r / 2**15 * G for r in (3, 6, 12, 24)}, BOSCH_GYRO, 16, 16),
    "bmi160": (BOSCH, BOSCH_GYRO, 16, 16),
    "bmi270": (BOSCH, BOSCH_GYRO, 16, 16),
    "bno055": (
        dict.fromkeys((2, 4, 8, 16), 1e-3 * G),
        dict.fromkeys((125, 250, 500, 1000, 2000), 1 / 16 / RAD),
        16,
        16,
    ),
    "adxl345": (dict.fromkeys((2, 4, 8, 16), 3.9e-3 * G), {}, 13, 0),  # no-OS, adxl345.h: 0.0039 g
    "adxl355": ({2.048: 38.245e-6, 4.096: 76.490e-6, 8.192: 152.980e-6}, {}, 20, 0),  # m/s^2, no-OS, adxl355.h
    "adis16448": ({18: G / 1200}, {r: r / 25000 / RAD for r in (250, 500, 1000)}, 16, 16),  # PX4, ADIS16448.cpp
    "adis16470": ({40: G / 800}, {2000: 0.1 / RAD}, 16, 16),  # no-OS, adis1646x.c
    "stim300": (
        {r: G / 2**n for r, n in {2: 21, 5: 20, 10: 19, 30: 18, 80: 16}.items()},
        {400: 1 / 2**14 / RAD},
        24,
        24,
    ),
    "stim318": ({r: G / 2**n for r, n in {5: 20, 10: 19, 30: 18, 80: 16}.items()}, {400: 1 / 2**14 / RAD}, 24, 24),
}


@pytest.fixture(scope="module")
def compose(tmp_path_factory: pytest.TempPathFactory) -> Compose:
    composer = Composer(tmp_path_factory.mktemp("campaign"))
    return lambda *layers: composer.unit("U1", layers)


def test_every_chip_that_ships_is_compared_with_a_driver() -> None:
    assert set(DRIVERS) == set(FILES) - {"generic"}


@pytest.mark.parametrize("name", DRIVERS)
def test_counts_are_those_of_the_driver_and_fill_the_converter(name: str) -> None:
    *scales, bits_force, bits_rate = DRIVERS[name]
    parts = (("accelerometer", G, bits_force), ("gyroscope", 1 / RAD, bits_rate))
    for (part, unit, bits), of_driver in zip(parts, scales, strict=True):
        sheet: dict[str, Any] = FILES[name].get(part) or {}
        assert bool(sheet) == bool(of_driver)
        if not sheet:
            continue
        ranges = sheet.get("ranges") or {sheet["full_scale"]: sheet["counts_per_unit"]}
        assert set(ranges) == set(of_driver)
        assert ranges[sheet["full_scale"]] == sheet["counts_per_unit"]
        for full_scale, counts in ranges.items():
            assert unit / counts == pytest.approx(of_driver[full_scale], rel=5e-3)
            assert full_scale * counts <= 2 ** (bits - 1) * 1.002, "the range is beyond the converter"


@pytest.mark.parametrize("name", [n for n in FILES if n != "generic"])
def test_each_range_is_chosen_by_one_override(name: str, compose: Compose) -> None:
    for part in ("accelerometer", "gyroscope"):
        for full_scale, counts in ((FILES[name].get(part) or {}).get("ranges") or {}).items():
            config = compose(f"sensor={name}", f"sensor.{part}.range={full_scale:g}")
            sheet = config.sensor.of(part)
            assert (sheet.full_scale, sheet.counts_per_unit) == (full_scale, counts)


def test_a_log_in_counts_follows_the_range(compose: Compose) -> None:
    layers = ["sensor=bmi088", "ingest=arduino_counts", "sensor.accelerometer.range=6"]
    columns = compose(*layers).ingest.csv["columns"]
    assert columns["accel_x"]["counts_per_unit"] == 5460


def test_overrides_keep_their_precedence(compose: Compose) -> None:
    layers = ["sensor.accelerometer.range=6", "sensor=bmi088", "sensor.accelerometer.full_scale=5.5"]
    sheet = compose(*layers).sensor.accelerometer
    assert (sheet.full_scale, sheet.counts_per_unit) == (5.5, 5460)


@pytest.mark.parametrize(
    ("layers", "says"),
    [
        (["sensor=bmi088", "sensor.accelerometer.range=5"], "lists the ranges 3, 6, 12, 24"),
        (["sensor=generic", "sensor.gyroscope.range=250"], "none: set full_scale and counts_per_unit"),
        (["sensor=bmi088", "sensor.accelerometer.range=true"], "lists the ranges 3, 6, 12, 24"),
    ],
)
def test_a_range_that_the_file_does_not_list_is_refused(layers: list[str], says: str, compose: Compose) -> None:
    with pytest.raises(ConfigurationError, match=says):
        compose(*layers)


def test_figures_that_are_not_stated_are_those_of_generic_and_named(compose: Compose) -> None:
    sensor = compose("sensor=bmi055", "sensor.gyroscope.bias=1").sensor
    generic = FILES["generic"]
    for part, bias in (("accelerometer", generic["accelerometer"]["bias"]), ("gyroscope", 1)):
        sheet = sensor.of(part)
        assert sheet.noise_density == generic[part]["noise_density"]
        assert sheet.effects == generic[part]["effects"]
        assert sheet.bias == bias
        assert ("bias" in sheet.assumed) == (part == "accelerometer")
        assert sheet.stated("noise_density") is None
        assert sheet.stated("full_scale") == sheet.full_scale
    bmi055, adxl355 = (shipped_settings(sensor=name).sensor for name in ("bmi055", "adxl355"))
    assert bmi055.accelerometer.noise_density == generic["accelerometer"]["noise_density"]
    assert adxl355.gyroscope.counts_per_unit == generic["gyroscope"]["counts_per_unit"]


def test_a_sheet_that_is_complete_stays_as_it_is(compose: Compose) -> None:
    sensor = compose("sensor=mpu6050").sensor
    assert sensor.accelerometer.assumed == []
    assert sensor.accelerometer.effects == FILES["mpu6050"]["accelerometer"]["effects"]
