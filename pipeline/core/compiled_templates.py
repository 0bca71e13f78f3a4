"""Templates that were compiled before, in the user's cache folder."""

from __future__ import annotations

import re
from collections.abc import MutableMapping
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
from jinja2.bccache import Bucket
from markupsafe import Markup, escape

from pipeline.core.files import from_cache, state_of_files, to_cache

_ESCAPED = re.compile("[&<>'\"]").search  # the characters that ``escape`` replaces


def _output(value: Any) -> str:  # noqa: ANN401  (any value of a template)
    """Return ``escape`` of a value; of a text without such characters the text itself, in a third of the time."""
    kind = type(value)
    return value if kind is Markup or (kind is str and not _ESCAPED(value)) else escape(value)


class Template(jinja2.Template):
    """A template whose code writes values by ``_output``: what it joins of them is not escaped again."""

    @classmethod
    def from_code(cls, *arguments: Any) -> jinja2.Template:  # noqa: ANN401  (of jinja2)
        """Return the template of compiled code."""
        made = super().from_code(*arguments)
        made.root_render_func.__globals__["escape"] = _output
        return made


class CompiledTemplates(jinja2.BytecodeCache):
    """The compiled templates of a package, for ``jinja2.Environment(bytecode_cache=...)``."""

    def __init__(self, package: str) -> None:
        self.package = package

    def get_cache_key(self, name: str, filename: str | None = None) -> str:  # noqa: ARG002  (as jinja2 calls it)
        """Return the name of a template in the cache."""
        return f"{self.package}-{name}"

    def load_bytecode(self, bucket: Bucket) -> None:
        """Load the code of a template."""
        bucket.code = from_cache(bucket.key, _state(bucket))

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Store the code of a template."""
        to_cache(bucket.key, _state(bucket), bucket.code)


class Templates(jinja2.Environment):
    """The templates of a package. Its globals are complete before the first is loaded.

    A name is looked up in a dict before its methods, because most names of the templates are keys.
    """

    template_class = Template

    def __init__(self, package: str, loader: jinja2.BaseLoader, **options: Any) -> None:  # noqa: ANN401  (of jinja2)
        compiled = CompiledTemplates(package)
        super().__init__(
            loader=loader, auto_reload=False, bytecode_cache=compiled, trim_blocks=True, lstrip_blocks=True, **options
        )

    def getattr(self, obj: Any, attribute: str) -> Any:  # noqa: ANN401  (as of the base class)
        """Return a value of a dict, or an attribute."""
        if type(obj) is dict and attribute in obj:
            return obj[attribute]
        return super().getattr(obj, attribute)

    def make_globals(self, d: MutableMapping[str, object] | None) -> MutableMapping[str, object]:
        """Return the globals of a template as a dict, which each rendering copies faster than a chain of two."""
        return {**self.globals, **(d or {})}


def _state(bucket: Bucket) -> str:
    return f"{_jinja()} {bucket.checksum}"  # of its source


@cache
def _jinja() -> str:
    return state_of_files(Path(jinja2.__file__).parent.glob("*.py"))
