"""Strict TOML: text in, a frozen record out, or one line that says which key is wrong.

The law: a key or tag that the record does not know is refused by its path, with the nearest known one beside it.
"""

import difflib
import math
import tomllib
import types
import typing
from collections.abc import Iterator
from typing import Any, TypeVar

import msgspec

from hw_profiles.errors import BadInputError


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A strict record: a key that is not a field of it is an error."""


RecordT = TypeVar("RecordT", bound=Record)


def parse_toml(text: str, kind: type[RecordT], what: str) -> RecordT:
    """The record in a TOML text; `what` opens the error line. Raises: BadInputError."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BadInputError(f"{what}: not TOML: {error}") from error
    for unknown, word, known in _unknown_words(raw, kind, ""):
        near = difflib.get_close_matches(word, known, n=1, cutoff=0.0)
        raise BadInputError(f"{what}: unknown {unknown}; the nearest known one is {near[0]}")
    for key in _unreal_numbers(raw, ""):
        raise BadInputError(f"{what}: {key} is no finite number")
    try:
        return msgspec.convert(raw, kind)
    except msgspec.ValidationError as error:
        raise BadInputError(f"{what}: {str(error).replace(' - at `$.', ' at `')}") from error


def _unknown_words(raw: object, expected: Any, where: str) -> Iterator[tuple[str, str, list[str]]]:
    """Each key of `raw` that the record `expected` lacks, and each tag that no record of its union has.

    Yields it with its path, the word alone, and the words known there.
    """
    if isinstance(expected, types.UnionType):
        field, records = _tagged(expected)
        tag = raw.get(field) if isinstance(raw, dict) else None
        if isinstance(tag, str) and tag not in records:
            yield f"{field} {tag!r} at `{where}.{field}`", tag, list(records)
            return
        expected = records.get(str(tag), typing.get_args(expected)[0])  # the first, where no tag tells
    if isinstance(raw, list) and typing.get_origin(expected) is list:
        for index, item in enumerate(raw):
            yield from _unknown_words(item, typing.get_args(expected)[0], f"{where}[{index}]")
    if not (isinstance(raw, dict) and isinstance(expected, type) and issubclass(expected, msgspec.Struct)):
        return
    hints = typing.get_type_hints(expected)
    known = [name for name in hints if not name.startswith("__")]
    tag_field = expected.__struct_config__.tag_field
    for key, value in raw.items():
        path = f"{where}.{key}".lstrip(".")
        if key in known:
            yield from _unknown_words(value, hints[key], path)
        elif key != tag_field:
            yield f"key {path}", key, known


def _tagged(union: types.UnionType) -> tuple[str, dict[str, Any]]:
    """The key that holds the tag, and the records of the union by their tags; nothing of a union without tags."""
    configs = {each: getattr(each, "__struct_config__", None) for each in typing.get_args(union)}
    tagged = {each: config for each, config in configs.items() if config is not None and config.tag}
    field = next((str(config.tag_field) for config in tagged.values()), "")
    return field, {str(config.tag): each for each, config in tagged.items()}


def _unreal_numbers(raw: object, where: str) -> Iterator[str]:
    """The path of each infinity or NaN (TOML has words for them): no bound would stop a NaN."""
    if isinstance(raw, float) and not math.isfinite(raw):
        yield where
    elif isinstance(raw, dict):
        for key, value in raw.items():
            yield from _unreal_numbers(value, f"{where}.{key}".lstrip("."))
    elif isinstance(raw, list):
        for index, item in enumerate(raw):
            yield from _unreal_numbers(item, f"{where}[{index}]")
