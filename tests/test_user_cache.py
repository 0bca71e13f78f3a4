"""What is kept in the user's cache: only what nobody else can write, and only while it follows from the same code."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import jinja2
import pytest

from pipeline.core import files as user_cache
from pipeline.core.compiled_templates import CompiledTemplates
from pipeline.core.files import cache_folder, from_cache, to_cache

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).parents[1]
CONFIG = [sys.executable, "-m", "pipeline", "config", "mpu6050-1"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(user_cache, "_used", [True])
    cache_folder.cache_clear()
    yield tmp_path / "cache" / "imu-calibration"
    cache_folder.cache_clear()


def test_a_value_is_kept_as_it_is_for_the_same_state(folder: Path) -> None:
    value = {"ranges": {2: 16384.0, 4: None}, "list": [1, 0.1, "text", True]}
    to_cache("one", "state", value)
    assert from_cache("one", "state") == value
    assert list(from_cache("one", "state")["ranges"]) == [2, 4]
    assert from_cache("one", "other") is None
    assert from_cache("two", "state") is None
    assert (folder.stat().st_mode & 0o777, folder.parent.stat().st_uid) == (0o700, os.getuid())


@pytest.mark.parametrize("damaged", [b"", b"0" * 80, lambda content: content[:-1], lambda content: content + b"x"])
def test_a_damaged_file_is_not_used(folder: Path, damaged: object) -> None:
    to_cache("one", "state", [1, 2])
    content = (folder / "one").read_bytes()
    (folder / "one").write_bytes(damaged(content) if callable(damaged) else damaged)
    assert from_cache("one", "state") is None
    to_cache("one", "state", [1, 2])
    assert from_cache("one", "state") == [1, 2]


def test_a_folder_that_others_can_write_is_not_used(folder: Path) -> None:
    folder.mkdir(parents=True)
    folder.chmod(0o770)
    to_cache("one", "state", [1, 2])
    assert cache_folder() is None
    assert list(folder.iterdir()) == []


def test_a_link_to_another_folder_is_not_used(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir(mode=0o700)
    folder.parent.mkdir()
    folder.symlink_to(tmp_path / "other")
    assert cache_folder() is None


def test_changed_code_of_the_package_forgets_the_values(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    to_cache("one", "state", [1, 2])
    assert (folder / "one").is_file()
    monkeypatch.setattr(user_cache, "_program", lambda: "other code")
    assert from_cache("one", "state") is None


def test_a_template_is_compiled_once_and_again_where_its_text_has_changed(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def rendered(text: str) -> str:
        loader = jinja2.DictLoader({"a.txt": text})
        environment = jinja2.Environment(loader=loader, bytecode_cache=CompiledTemplates("test"), autoescape=True)
        return environment.get_template("a.txt").render(name="<x>")

    assert rendered("Hello {{ name }}") == "Hello &lt;x&gt;"
    assert [file.name for file in folder.iterdir()] == ["test-a.txt"]
    with monkeypatch.context() as patch:
        patch.setattr(jinja2.Environment, "compile", lambda *_, **__: 1 / 0)
        assert rendered("Hello {{ name }}") == "Hello &lt;x&gt;"
    assert rendered("Bye {{ name }}") == "Bye &lt;x&gt;"


def test_commands_work_where_no_cache_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    environment = {key: value for key, value in os.environ.items() if key not in ("HOME", "XDG_CACHE_HOME")}

    def said(home: str, cache: str) -> str:
        places = {"HOME": home, "XDG_CACHE_HOME": cache, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(CONFIG, env=environment | places, cwd=ROOT, capture_output=True, text=True, check=True)
        return done.stdout

    without = {said("/proc/nobody", cache) for cache in ("/proc/nobody", f"{tmp_path}/file", "relative")}
    with_it = {said("/proc/nobody", str(tmp_path / "cache")) for _ in range(2)}
    assert len(without) == 1
    assert with_it == without
    assert list((tmp_path / "cache" / "imu-calibration").glob("configuration-*"))
