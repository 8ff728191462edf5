"""Reading TOML into tables with one clear sentence for each mistake, and writing it."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NoReturn, TypeVar, get_args, get_type_hints

from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from asia._files import read_file
from asia._text import nearest
from asia.errors import UserError
from asia.problem.budget import LEAST_MEMORY_MB

_EXPECTED = {
    "string_type": "text in quotes",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "tuple_type": "a list in [ ]",
    "dict_type": "a table",
    "mapping_type": "a table",
    "dataclass_type": "a table",
    "finite_number": "a finite number",
    "too_short": "at least one entry",
    "string_too_short": "a name",
}

T = TypeVar("T")


def read_table(path: Path, schema: type[T]) -> T:
    """`path` checked against `schema`.

    Raises:
        UserError: at most three sentences
    """
    try:
        text = read_file(path, "name a problem file").decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not UTF-8 text: save it as UTF-8") from error
    return parse_table(text, schema, path.name, str(path))


def parse_table(text: str, schema: type[T], name: str, place: str = "") -> T:
    """TOML checked against `schema`.

    Args:
        name: of the text, in messages
        place: of the text, in messages on its syntax

    Raises:
        UserError: at most three sentences
    """
    place = place or name

    def refuse_date(value: object) -> NoReturn:
        raise UserError(f"{value} is a date or a time, which no key of a problem file takes")

    try:
        raw = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{place} is not valid TOML: {error}") from error
    try:
        # As JSON, where strictness takes a list for a tuple and a table for a dataclass.
        content = json.dumps(raw, default=refuse_date)
    except RecursionError as error:
        raise UserError(f"{place}: its tables are nested too deeply") from error
    try:
        return TypeAdapter(schema).validate_json(content)
    except ValidationError as error:
        sentences = [_sentence(e, schema) for e in error.errors(include_url=False)]
        if len(sentences) > 3:
            sentences[3:] = [f"and {len(sentences) - 3} more"]
        raise UserError(f"{name}: {'; '.join(sentences)}") from error


def _sentence(error: ErrorDetails, schema: type) -> str:
    *where, key = error["loc"] or ("",)
    table = f"[{_path(where)}]" if where else "the top level"
    name = _path(error["loc"])
    context: Mapping[str, Any] = error.get("ctx", {})
    kind = error["type"]
    match kind:
        case "unexpected_keyword_argument":
            return f"unknown key '{key}' in {table}{nearest(str(key), _known_keys(schema, where))}"
        case "missing":
            return f"'{key}' is missing in {table}"
        case "value_error":
            reason = str(context.get("error", error["msg"]))
            return f"{name} {reason}" if reason.startswith("is ") else f"{name} = {reason}"
        case "greater_than":
            expected = f"a number above {context['gt']:g}"
        case "greater_than_equal":
            expected = f"at least {context['ge']:g}"
        case "less_than" | "less_than_equal":
            expected = f"at most {context.get('le', context.get('lt')):g}"
        case "literal_error":
            expected = str(context["expected"])
        case _:
            expected = _EXPECTED.get(kind) or error["msg"].removeprefix("Input should be ")
    shown = json.dumps(error["input"], default=str, ensure_ascii=False)
    if len(shown) > 60:
        shown = shown[:57] + "..."
    if name == "budget.memory_mb" and kind == "greater_than_equal":
        return (
            f"budget.memory_mb is {shown}: JAX cannot start under {LEAST_MEMORY_MB} MB, "
            f"set it to {LEAST_MEMORY_MB} or more"
        )
    return f"{name} is {shown}, expected {expected}"


def _path(where: Sequence[int | str]) -> str:
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in where)
    return text.removeprefix(".")


def _known_keys(schema: type, where: Sequence[int | str]) -> list[str]:
    table = schema
    for part in where:
        hints = get_type_hints(table, include_extras=True)
        if part in hints:
            table = _table_in(hints[str(part)]) or table
    return [field.name for field in fields(table)]


def _table_in(annotation: object) -> type | None:
    if isinstance(annotation, type) and is_dataclass(annotation):
        return annotation
    found = (_table_in(argument) for argument in get_args(annotation))
    return next((table for table in found if table), None)


def toml_text(tables: Mapping[str, Any]) -> str:
    """TOML of nested mappings of str, int, float, bool, lists and mappings, None left out, in their
    order: that of the output groups is part of the protocol's digest, and writers that put tables
    behind values lose it."""
    return "\n".join(_lines(tables, ())).lstrip("\n") + "\n"


def _lines(table: Mapping[str, Any], path: tuple[str, ...]) -> list[str]:
    present = {k: v for k, v in table.items() if v is not None}
    # A table of its own would end up behind the values that follow it: there order would be lost.
    last = max((i for i, v in enumerate(present.values()) if not isinstance(v, Mapping)), default=0)
    own = {k: v for i, (k, v) in enumerate(present.items()) if isinstance(v, Mapping) and i > last}
    lines = [f"{_key(k)} = {toml_value(v)}" for k, v in present.items() if k not in own]
    for key, value in present.items():
        if key in own:
            inner = (*path, _key(key))
            lines += ["", f"[{'.'.join(inner)}]", *_lines(value, inner)]
    return lines


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else toml_value(key)


def toml_value(value: Any) -> str:
    """One value on one line."""
    if isinstance(value, str):
        # A JSON string is a TOML string but for the delete character, which TOML wants escaped.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, Mapping):
        inner = (f"{_key(k)} = {toml_value(v)}" for k, v in value.items() if v is not None)
        return "{ " + ", ".join(inner) + " }"
    return "[" + ", ".join(toml_value(v) for v in value) + "]"
