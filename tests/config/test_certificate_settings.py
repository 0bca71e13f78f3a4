"""What a laboratory states is chosen like any group, checked, and no part of what identifies a calibration."""

from pathlib import Path

import pytest

from pipeline.app.config import load_campaign
from pipeline.app.config.campaign import UnitRow
from pipeline.core.errors import ConfigurationError


def campaign(folder: Path, laboratory: str) -> Path:
    (folder / "configs" / "certificate").mkdir(parents=True)
    (folder / "configs" / "certificate" / "mine.yaml").write_text(laboratory)
    (folder / "units.csv").write_text("unit,certificate\nU1,mine\nU2,\n")
    return folder


def test_a_unit_takes_the_laboratory_of_its_row_and_keeps_its_hash(tmp_path: Path) -> None:
    loaded = load_campaign({"campaign": str(campaign(tmp_path, "laboratory: {name: Mine}\nissued: 2026-03-01\n"))})
    mine, blank = (loaded.units[u].config for u in ("U1", "U2"))
    assert (mine.certificate.laboratory.name, mine.certificate.issued) == ("Mine", "2026-03-01")
    assert blank.certificate.laboratory.name is None
    digests = [
        UnitRow("U1", {}, config).config_sha256
        for config in (
            mine,
            mine.replaced(certificate=blank.certificate),
            mine.replaced(filter=blank.filter.replaced(order=3)),
        )
    ]
    assert digests[0] == digests[1] != digests[2]


def test_a_date_that_is_none_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"certificate\.issued"):
        load_campaign({"campaign": str(campaign(tmp_path, "issued: 1 March\n"))})


@pytest.mark.parametrize("number", ["K-7", "K-7-{serial}"])
def test_one_number_for_the_reports_of_two_units_is_refused(tmp_path: Path, number: str) -> None:
    folder = campaign(tmp_path, f'number: "{number}"\n')
    load_campaign({"campaign": str(folder)})
    (folder / "units.csv").write_text("unit,certificate,serial\nU1,mine,\nU2,mine,\nU3,mine,12\n")
    with pytest.raises(ConfigurationError, match="have one number; write"):
        load_campaign({"campaign": str(folder)})
