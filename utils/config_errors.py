"""Saying what is wrong with a config: key, value, whence it came, what is allowed, nearest key.

What is allowed is read from the JSON schema, so that messages cannot disagree with the checks.
This module knows the schema, but not how a config is read.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError

from utils.config_schema import Config
from utils.config_types import OBJECT_SETS, Section
from utils.errors import UserError, did_you_mean

DEFAULTS = Path(__file__).resolve().parent.parent / "configs" / "default.yaml"


class ConfigError(UserError):
    """A config that cannot be used: the message holds key, value, what is allowed, nearest key."""


class Layer(NamedTuple):
    """Keys from one source; a later layer wins over an earlier one."""

    source: str
    values: dict[str, Any]


@cache
def _schema() -> dict[str, Any]:
    return Config.model_json_schema()


def _resolve(schema: dict[str, Any]) -> dict[str, Any]:
    reference = schema.get("$ref")
    return _schema()["$defs"][reference.rsplit("/", 1)[1]] if reference else schema


def schema_at(key: str) -> dict[str, Any] | None:
    """The JSON schema of a dotted key, or None where there is no such key."""
    schema = _schema()
    for part in key.split("."):
        schema = _resolve(schema).get("properties", {}).get(part)
        if schema is None:
            return None
    return _resolve(schema)


def known_keys(schema: dict[str, Any] | None = None, prefix: str = "") -> Iterator[str]:
    """Every dotted key, sections included."""
    for name, child in (schema or _schema())["properties"].items():
        yield prefix + name
        child = _resolve(child)
        if "properties" in child:
            yield from known_keys(child, f"{prefix}{name}.")


def alternatives(schema: dict[str, Any]) -> list[dict[str, Any]]:
    return schema.get("anyOf", [schema])


_NOUNS = {"integer": "whole number", "number": "number", "string": "text", "boolean": "true/false"}
_BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


def allowed(schema: dict[str, Any]) -> str:
    """What a key takes, in words: 'a whole number >= 1, or null'."""
    if "anyOf" in schema:
        return ", or ".join(allowed(part) for part in schema["anyOf"])
    if "properties" in schema:
        return f"a section with the keys {', '.join(schema['properties'])}"
    if schema.get("type") == "array":
        fixed = schema.get("prefixItems")
        if fixed:
            same = f"a list of {len(fixed)} {_NOUNS[fixed[0]['type']]}s"
            return schema.get("description", same)
        return f"a list of at least one, each {allowed(schema['items'])}"
    if schema.get("type") == "null":
        return "null"
    if "enum" in schema:
        return f"one of {', '.join(schema['enum'])}"
    if "description" in schema:
        return schema["description"]
    noun = _NOUNS[schema["type"]]
    bounds = " and ".join(f"{sign} {schema[k]}" for k, sign in _BOUNDS.items() if k in schema)
    if schema["type"] == "string":
        return "text that is not empty" if schema.get("minLength") else "text"
    return f"a {noun} {bounds}".rstrip()


def explain(error: ValidationError, layers: Sequence[Layer]) -> str:
    """The first problem as one sentence, and how many more there are."""
    problems = error.errors()
    first = problems[0]
    location = [str(part) for part in first["loc"] if isinstance(part, str)]
    key = ".".join(location)
    while location and schema_at(".".join(location)) is None:
        location.pop()  # pydantic may append names of its own after the key
    source = _source(key.split("."), layers)
    if first["type"] == "extra_forbidden":
        message = unknown_key(key, source)
    elif first["type"] == "missing" and isinstance(first["loc"][-1], str):
        message = f"{key}: not set in {DEFAULTS}; every key needs its default there"
    elif not location:
        message = f"{key or source}: {first['msg']}; keys are text as in {DEFAULTS.name}"
    else:
        known = ".".join(location)
        items = [] if first["type"] == "missing" else first["loc"]  # there is no such item
        index = "".join(f"[{part}]" for part in items if isinstance(part, int))
        schema = schema_at(known)
        if isinstance(first["input"], dict | Section) and first["type"] == "value_error":
            message = f"{known}: {first['ctx']['error']} ({source})"  # a rule between keys
        else:
            reason = f", {first['ctx']['error']}" if first["type"] == "value_error" else ""
            message = (
                f"{known}{index}: got {_shown(first['input'])} ({source}){reason}; "
                f"expected {allowed(schema)}{_near_choice(first['input'], schema)}"
            )
    more = len({tuple(p for p in e["loc"] if isinstance(p, str)) for e in problems}) - 1
    return message + (f" (and {more} more problem{'s' * (more > 1)})" if more else "")


def unknown_key(key: str, source: str) -> str:
    parent, _, leaf = key.rpartition(".")
    section = schema_at(parent) if parent else None
    if section and "properties" in section:  # a misspelt key in a known section
        known = list(known_keys(section, f"{parent}."))
    else:
        known = list(known_keys())
    leaves = {name.rpartition(".")[2]: name for name in known}
    near = [name for name in known if name.rpartition(".")[2] == leaf]
    near = near or difflib.get_close_matches(key, known, n=1, cutoff=0.75)
    near = near or [leaves[m] for m in difflib.get_close_matches(leaf, leaves, n=1, cutoff=0.7)]
    if near:
        return f"{key}: unknown key ({source}); did you mean {' or '.join(near)}?"
    keys = ", ".join((section or {}).get("properties", _schema()["properties"]))
    return f"{key}: unknown key ({source}); allowed here: {keys}"


def _near_choice(value: object, schema: dict[str, Any]) -> str:
    choices: list[str] = []
    for part in alternatives(schema):
        part = part.get("items", part)
        if "description" in part:
            choices += OBJECT_SETS
        choices += part.get("enum", [])
    return did_you_mean(value, choices) if isinstance(value, str) else ""


def _source(parts: Sequence[str], layers: Sequence[Layer]) -> str:
    """The last layer that set a key or something inside it."""
    for layer in reversed(layers):
        values: Any = layer.values
        for part in parts:
            if not isinstance(values, dict) or part not in values:
                break
            values = values[part]
        else:
            return layer.source
    return layers[-1].source


def _shown(value: object) -> str:
    text = (
        "null" if value is None else str(value).lower() if isinstance(value, bool) else repr(value)
    )
    return text if len(text) <= 60 else text[:57] + "..."
