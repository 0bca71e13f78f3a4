"""The documents name files and functions that exist."""

import re
import runpy
from pathlib import Path

import pytest
from document_tables import with_tables

ROOT = Path(__file__).parents[1]
DOCUMENTS = [
    *sorted((ROOT / "docs").glob("*.md")),
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "workflow/README.md")),
]
PATH = re.compile(r"`((?:pipeline|configs|tests|workflow|benchmarks|docs)/[^`\s]*)`")
PLACEHOLDER = re.compile(r"<|[A-Z]{4}|/my_")  # configs/effect/NAME.yaml, configs/effect/<name>.yaml, my_laboratory
LINK = re.compile(r"\]\((?!http|#)([^)#]+)")
ANCHOR = re.compile(r"\]\((?!http)([^)#]*)#([^)]+)\)")
FUNCTION = re.compile(r"`([\w.]+)`\s+(?:in|\()\s*`(pipeline/[\w/]+\.py)`")


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda file: file.name)
def test_files_that_a_document_names_exist(document: Path) -> None:
    text = document.read_text()
    named = [path for path in PATH.findall(text) if not PLACEHOLDER.search(path)]
    missing = [path for path in named if not list(ROOT.glob(path.rstrip("/")))]
    missing += [link for link in LINK.findall(text) if not (document.parent / link).exists()]
    assert not missing


def headings(document: Path) -> set[str]:
    """Return the anchors of the headings of a document, as GitHub forms them."""
    found = re.findall(r"^#+ (.*)$", document.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in found}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda file: file.name)
def test_headings_that_a_link_names_exist(document: Path) -> None:
    linked = ANCHOR.findall(document.read_text())
    assert not [
        (file, anchor)
        for file, anchor in linked
        if anchor not in headings(document.parent / file if file else document)
    ]


def test_every_document_is_in_the_index() -> None:
    index = (ROOT / "docs" / "README.md").read_text()
    assert not [
        file.name for file in (ROOT / "docs").glob("*.md") if file.name != "README.md" and f"({file.name}" not in index
    ]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda file: file.name)
def test_generated_tables_are_those_of_the_code(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    assert text == with_tables(text), "run python tests/document_tables.py"


def test_the_documents_are_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 160
    assert sum(len(file.read_text().split()) for file in (ROOT / "docs").glob("*.md")) <= 25_000


def test_functions_that_the_architecture_names_exist() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text()
    named = FUNCTION.findall(text)
    missing = [
        (name, file)
        for name, file in named
        if not re.search(rf"^\s*(def|class) {name.rpartition('.')[2]}\b", (ROOT / file).read_text(), re.MULTILINE)
    ]
    assert len(named) > 20
    assert not missing


def test_drawings_are_those_of_the_geometry() -> None:
    script = runpy.run_path(str(ROOT / "docs" / "images" / "draw.py"))
    for name, text in script["drawings"]().items():
        found = (ROOT / "docs" / "images" / name).read_text()
        assert found == text, f"docs/images/{name}: run python docs/images/draw.py"
