"""What a campaign's configuration becomes, and what is refused before any job."""

from pathlib import Path

import pytest

from pipeline.app.config import Campaign, load_campaign
from pipeline.app.config.campaign import find_campaign
from pipeline.app.config.stage_settings import settings_in_memory
from pipeline.core.errors import ConfigurationError


def campaign(tmp_path: Path, sheet: str, settings: str = "") -> Path:
    directory = tmp_path / "bench"
    directory.mkdir(exist_ok=True)
    (directory / "units.csv").write_text(sheet)
    if settings:
        (directory / "campaign.yaml").write_text(settings)
    return directory


def load(directory: Path, **settings: object) -> Campaign:
    return load_campaign({"campaign": str(directory), **settings})


def test_each_layer_of_precedence_is_stronger_than_the_one_before(tmp_path: Path) -> None:
    sheet = "unit,filter,overrides\nU1,,\nU2,rc_low_pass,\nU3,,filter.cutoff_hz=3\nU4,,filter.cutoff_hz=3\n"
    directory = campaign(tmp_path, sheet, "overrides: [filter=low_pass, filter.cutoff_hz=1]")
    units = load(directory).units
    assert [units[u].config.filter.name for u in units] == ["low_pass", "rc_low_pass", "low_pass", "low_pass"]
    assert [units[u].config.filter.cutoff_hz for u in units] == [1, 1, 3, 3]
    run = load(directory, overrides=["filter.cutoff_hz=4"], unit_overrides={"U4": ["filter.cutoff_hz=5"]}).units
    assert [run[u].config.filter.cutoff_hz for u in run] == [4, 4, 4, 5]
    swapped = load(directory, overrides="filter=none", unit_overrides={"U1": ["filter=high_pass"]}).units
    assert [swapped[u].config.filter.name for u in swapped] == ["high_pass", "none", "none", "none"]


def test_the_command_line_is_stronger_than_the_campaign_for_settings_of_the_run(tmp_path: Path) -> None:
    directory = campaign(tmp_path, "unit\nU1\nU2\nU3\n", "overrides: [batch_size=1, publish_limit=7]")
    assert (len(load(directory).batches), load(directory).publish_limit) == (3, 7)
    stated = load(directory, overrides=["batch_size=2"])
    assert (len(stated.batches), stated.publish_limit) == (2, 7)


def test_a_plain_string_is_one_override(tmp_path: Path) -> None:
    directory = campaign(tmp_path, "unit\nU1\n")
    assert load(directory, overrides="table.gravity_g=0.998").units["U1"].config.table.gravity_g == 0.998


def test_a_semicolon_in_quotes_does_not_separate_overrides(tmp_path: Path) -> None:
    cell = '"ingest.csv.delimiter="";"";filter.cutoff_hz=3"'
    directory = campaign(tmp_path, f"unit,overrides\nU1,{cell}\nU2,ingest.csv.delimiter=semicolon\n")
    units = load(directory).units
    assert units["U1"].config.ingest.csv["delimiter"] == ";"
    assert units["U1"].config.filter.cutoff_hz == 3
    assert units["U2"].config.ingest.csv["delimiter"] == "semicolon"


def test_an_edited_option_of_the_campaign_is_read_again(tmp_path: Path) -> None:
    """A notebook loads a campaign several times in one process."""
    directory = campaign(tmp_path, "unit,procedure\nU1,own\n")
    file = directory / "configs" / "procedure" / "own.yaml"
    file.parent.mkdir(parents=True)
    for table, tolerance, wanted in (
        ("hand", 5.0, "nonlinear_least_squares"),
        ("mark2", 17.0, "reference_least_squares"),
    ):
        lines = f"table: {table}\nmounting_tolerance_deg: {tolerance}\n"
        file.write_text(f"defaults: [three_axis_turns, _self_]\n{lines}")
        unit = load(directory).units["U1"].config
        assert (unit.table.name, unit.procedure.mounting_tolerance_deg) == (table, tolerance)
        assert unit.method.name == wanted


def test_defaults_follow_the_procedure_and_the_table(tmp_path: Path) -> None:
    sheet = "unit,procedure,table\nA,,\nB,multi_position,\nC,,hand\nD,six_positions,acutronic\n"
    units = load(campaign(tmp_path, sheet)).units
    chosen = [(u.config.table.name, u.config.method.name) for u in units.values()]
    assert chosen == [
        ("acutronic", "reference_least_squares"),
        ("hand", "nonlinear_least_squares"),
        ("hand", "nonlinear_least_squares"),
        ("acutronic", "nonlinear_least_squares"),
    ]


def test_a_procedure_may_choose_table_and_method(tmp_path: Path) -> None:
    sheet = "unit,procedure,method,overrides\nA,ferraris,,procedure.turns.accuracy_deg=0.5\nB,ferraris,staged,\n"
    units = load(campaign(tmp_path, sheet)).units
    chosen = [(u.config.table.name, u.config.method.name) for u in units.values()]
    assert chosen == [("hand", "rests_and_moves"), ("hand", "staged")]
    assert [u.config.procedure.turns.accuracy_deg for u in units.values()] == [0.5, 3.0]


def test_methods_are_chosen_sensor_by_sensor(tmp_path: Path) -> None:
    sheet = "unit,method,overrides\nA,staged,method.gyroscope=cholesky_lu\n"
    config = load(campaign(tmp_path, sheet)).units["A"].config.method
    assert config.stages.json_value == {
        "accelerometer": ["orthogonality", "misalignment", "bias", "scale_factor"],
        "gyroscope": ["bias", "cholesky_lu"],
    }


def test_everything_that_is_wrong_is_said_in_one_message(tmp_path: Path) -> None:
    sheet = (
        "unit,method,overrides\n"
        "U1,stagd,\nU2,,filter.cutof_hz=5\nU3,,filter.cutoff_hz=fast\nU4,,table.gravity_g=9.81\n"
        "U5,,effects.gyroscope=[g_sensitivty]\nU6,,effects.accelerometer=[g_sensitivity]\nU7,,nonsense\n"
        "U8,,filter.cutof_hz=5\nU9,,table.latitude_deg=13\nV1,,batch_size=4\nV2,,method.gyroscope=nonlinear_least_squares\n"
        'V3,,"effects.accelerometer=[lever_arm,inner_lever_arms]"\nV4,,"effects.gyroscope=[g_sensitivity,g_sensitivity]"\n'
    )
    with pytest.raises(ConfigurationError) as refused:
        load(campaign(tmp_path, sheet))
    text = str(refused.value)
    for expected in (
        "unit U1: method=stagd: no such method; nearest: staged",
        "unit U2, U8: filter.cutof_hz=5: unknown key; nearest: cutoff_hz",
        'unit U3: filter.cutoff_hz="fast": input should be a valid number',
        "unit U4: table.gravity_g=9.81: input should be less than 1.1",
        "unit U5: effects.gyroscope: no effect is called 'g_sensitivty'; nearest: g_sensitivity",
        "unit U6: effects.accelerometer: g_sensitivity applies to the gyroscope only",
        "unit U7: 'nonsense' is not a Hydra override",
        "unit U9: table.latitude_deg and table.azimuth_deg: set both",
        "unit V1: batch_size=4: batch_size is a setting of the run",
        "unit V2: method.gyroscope=nonlinear_least_squares: nonlinear_least_squares has no stages for the gyroscope",
        "unit V3: effects.accelerometer names inner_lever_arms and lever_arm, which it contains: name one",
        "unit V4: effects.gyroscope names an effect twice: g_sensitivity, g_sensitivity",
    ):
        assert expected in text


def test_unknown_units_and_settings_are_refused_with_the_nearest_name(tmp_path: Path) -> None:
    directory = campaign(tmp_path, "unit\nUnit-1\n")
    with pytest.raises(ConfigurationError, match=r"no unit 'Unit-2' in units.csv; nearest: Unit-1"):
        load(directory, unit_overrides={"Unit-2": ["filter=none"]})
    with pytest.raises(ConfigurationError, match="lists within are quoted"):
        load(directory, unit_overrides="{Unit-1: [effects.gyroscope=[g_sensitivity]]}")
    with pytest.raises(ConfigurationError, match="overides: unknown setting; nearest: overrides"):
        load(directory, overides="filter=none")
    with pytest.raises(ConfigurationError, match="campaign 'demmo': neither data/demmo nor demmo holds"):
        load_campaign({"campaign": "demmo"})
    with pytest.raises(ConfigurationError, match="is not a list of overrides; quote each one"):
        load(directory, overrides="[filter=none, table=hand")


@pytest.mark.parametrize(
    ("sheet", "message"),
    [
        ("name\nU1\n", "has no column 'unit'"),
        ("unit\nU 1\n", r"line 2: unit 'U 1': use letters"),
        ("unit\nU1\nU1\n", "line 3: unit 'U1' stands twice"),
        ("unit,lot\nU1\n", "line 2: 2 columns expected"),
        ("unit\n", "has no units"),
    ],
)
def test_a_broken_units_csv_is_refused_with_its_line(tmp_path: Path, sheet: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        load(campaign(tmp_path, sheet))


def test_appending_units_touches_the_last_batch_of_their_chain_only(tmp_path: Path) -> None:
    rows = "unit,method\n" + "".join(f"U{i},{'staged' if i % 2 else ''}\n" for i in range(10))
    directory = campaign(tmp_path, rows)
    before = load(directory, overrides="batch_size=2").batches
    (directory / "units.csv").write_text(rows + "U10,\nU11,\n")
    after = load(directory, overrides="batch_size=2").batches
    assert {b: u for b, u in after.items() if before.get(b) != u} == {"reference_least_squares-0003": ["U8", "U10"]} | {
        "reference_least_squares-0004": ["U11"]
    }


def test_batches_grow_along_the_sheet_and_appending_still_touches_the_last_one_only(tmp_path: Path) -> None:
    rows = "unit\n" + "".join(f"U{i:03d}\n" for i in range(450))
    directory = campaign(tmp_path, rows)
    before = load(directory).batches
    assert [len(units) for units in before.values()] == [25, 25, 50, 100, 160, 90]
    (directory / "units.csv").write_text(rows + "".join(f"V{i}\n" for i in range(100)))
    after = load(directory).batches
    last, new = list(after)[-2:]
    assert {b for b, u in after.items() if before.get(b) != u} == {last, new}
    assert (len(after[last]), len(after[new])) == (160, 30)
    assert [u for units in after.values() for u in units] == list(load(directory).units)


def test_the_stage_of_effects_follows_where_a_unit_of_the_batch_asks_for_it(tmp_path: Path) -> None:
    directory = campaign(tmp_path, "unit,overrides\nA,\nB,effects.gyroscope=[g_sensitivity]\n")
    chains = load(directory).chains["reference_least_squares-0001"]
    assert chains == {"accelerometer": ["reference_least_squares"], "gyroscope": ["reference_least_squares", "effects"]}


def test_a_stage_sees_its_own_settings_only(tmp_path: Path) -> None:
    directory = campaign(tmp_path, "unit\nA\n")
    base, changed = (load(directory, overrides=o).units["A"] for o in ([], "limits.gyroscope.bias=3"))
    same = [
        s
        for s in ("ingest", "filter", "fit", "diagnose", "export")
        if settings_in_memory(base, s, "gyroscope") == settings_in_memory(changed, s, "gyroscope")
    ]
    assert same == ["ingest", "filter", "fit", "diagnose", "export"]
    assert settings_in_memory(base, "validate") != settings_in_memory(changed, "validate")
    with pytest.raises(AttributeError, match="limits"):
        _ = settings_in_memory(base, "diagnose").limits


def test_a_campaigns_own_configs_are_options(tmp_path: Path) -> None:
    directory = campaign(tmp_path, "unit,table\nA,mine\n")
    own = directory / "configs" / "table"
    own.mkdir(parents=True)
    shipped = Path(__file__).parents[2] / "configs" / "table" / "acutronic.yaml"
    own.joinpath("mine.yaml").write_text(shipped.read_text().replace("gravity_g: 1.0", "gravity_g: 0.999"))
    table = load(directory).units["A"].config.table
    assert (table.name, table.gravity_g) == ("mine", 0.999)


def test_a_campaign_whose_run_makes_the_recordings_reads_them_among_the_results(tmp_path: Path) -> None:
    directory = campaign(tmp_path, "unit\nA\n", "simulate: true\n")
    with pytest.raises(ConfigurationError, match=r"needs simulation.yaml in the same folder"):
        load(directory)
    (directory / "simulation.yaml").write_text("units: [{unit: A}]\n")
    loaded = load(directory, results=str(tmp_path / "out"))
    assert loaded.simulation == directory / "simulation.yaml"
    assert loaded.folder("A") == tmp_path / "out" / "bench" / "simulated" / "raw" / "A"
    directory.joinpath("campaign.yaml").write_text("simulate: yes please\n")
    with pytest.raises(ConfigurationError, match="true or false is expected"):
        load(directory)


def test_an_effect_of_one_setup_needs_a_recording_that_is_made_there(tmp_path: Path) -> None:
    own = campaign(
        tmp_path, 'unit,procedure,overrides\nA,two,"effects.accelerometer=[table_tilt@home,mounting@home]"\n'
    )
    (own / "configs" / "procedure").mkdir(parents=True)
    entry = "{file: accel_x, role: accelerometer, axis: x, optional: false, setup: home}"
    text = f"table: acutronic\nfolder: raw/{{unit}}\nrecordings:\n  accel_x: {entry}\nholdout_every: 3\n"
    (own / "configs" / "procedure" / "two.yaml").write_text(text)
    names = load(own).units["A"].config.effects.accelerometer
    assert names == ["table_tilt@home", "mounting@home"]
    with pytest.raises(
        ConfigurationError, match="bias@hom: no recording of procedure two has setup: hom; nearest: home"
    ):
        load(own, overrides="effects.accelerometer=[bias@hom]")
    with pytest.raises(ConfigurationError, match="no effect is called 'bias'"):
        load(own, overrides="effects.accelerometer=[bias]")


@pytest.mark.parametrize(
    ("stages", "words"),
    [
        (
            "[reference_least_squares, scale_factor]",
            "the stage scale_factor .* honour bias, matrix and effects of reference",
        ),
        ("[cholesky_lu]", "the stage cholesky_lu needs bias by an earlier stage"),
        ("[nonlinear_least_squares]", "no stage of the gyroscope is called 'nonlinear_least_squares'"),
        ("[noise]", "no stage of the gyroscope is called 'noise'"),
    ],
)
def test_stages_that_cannot_follow_each_other_are_refused_before_any_job(
    tmp_path: Path, stages: str, words: str
) -> None:
    directory = campaign(tmp_path, "unit\nU1\n")
    method = f"accelerometer: staged\ngyroscope: own\nas_printed: false\nstages: {{gyroscope: {stages}}}\n"
    file = directory / "configs" / "method" / "own.yaml"
    file.parent.mkdir(parents=True)
    file.write_text(method)
    with pytest.raises(ConfigurationError, match=rf"method\.gyroscope=own: {words}.*own\.yaml"):
        load(directory, overrides="method=own")


def test_a_directory_with_the_name_of_a_shipped_campaign_is_named_by_its_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / "units.csv").write_text("unit\n")
    monkeypatch.chdir(tmp_path)
    assert find_campaign("./demo") == (tmp_path / "demo").resolve()
    assert find_campaign("demo").parent.name == "data"
