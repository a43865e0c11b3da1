"""The configuration: YAML files and overrides in, checked and typed objects out.

`configs/default.yaml` is the one place of defaults, and `utils.config_schema` holds types and
ranges. A mistake is answered by one sentence: key, value, its source, what is allowed, the nearest
key. What is allowed is read from the JSON schema, so that messages cannot disagree with the checks.
This module knows neither simulators nor networks.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from pydantic import ValidationError

from utils.config_schema import Config
from utils.config_types import Section
from utils.errors import UserError, did_you_mean, one_line
from utils.plugins import code_named_in

__all__ = [
    "DEFAULTS",
    "Config",
    "ConfigError",
    "changed_keys",
    "dump_config",
    "load_config",
    "load_foreign",
    "load_yaml",
    "read_config",
    "values_of",
    "with_settings",
]

LARGEST_FILE = 1_000_000  # bytes of a config
# What PyYAML raises, besides its own errors: for dates and numbers that do not exist or have
# thousands of digits, and for lists in lists without end.
YAML_ERRORS = (yaml.YAMLError, ValueError, OverflowError, RecursionError)
DEFAULTS = Path(__file__).resolve().parent.parent / "configs" / "default.yaml"

# Keys of where a run computes, which change no result.
COMPUTE_KEYS = ("compute.scheduler", "compute.timeout")

# Keys that a file of data, such as a checkpoint, does not set: where to compute and to write.
FOREIGN_KEYS = (*COMPUTE_KEYS, "cache_dir")


class ConfigError(UserError):
    """A config that cannot be used: the message holds key, value, what is allowed, nearest key."""


class Layer(NamedTuple):
    """Keys from one source; a later layer wins over an earlier one."""

    source: str
    values: dict[str, Any]


# --- Reading ---------------------------------------------------------------------------------


def load_config(path: Path | None = None, overrides: Sequence[str] = ()) -> Config:
    """The defaults, with the keys of the YAML file `path` and then `overrides` laid over them.

    overrides: dotted assignments such as "evaluate.rounds=50"; the value is YAML, and a key that
    takes a list also takes "a,b" or a single item.
    Raises ConfigError on a missing file, bad YAML, an unknown key, a wrong type or range.
    """
    layers = [] if path is None else [Layer(str(path), read_config(Path(path)))]
    for layer in layers:
        _check_sections(layer)
    layers += [Layer("command line", _parse_override(text)) for text in overrides]
    return _over_defaults(layers)


def load_foreign(stored: Mapping[str, Any], source: str, overrides: Sequence[str] = ()) -> Config:
    """The config that a file of data brings, such as a checkpoint, with overrides laid over it.

    stored: plain data under the keys of this version. source: the file. Such a file may come from
    anywhere, so that it says neither where to compute and write (FOREIGN_KEYS) nor what code to
    run: the overrides have to name that. Raises ConfigError.
    """
    given = values_of(overrides)
    kept = _without(stored, FOREIGN_KEYS)
    config = _over_defaults([Layer(source, kept), Layer("command line", given)])
    named = {name for _, name in code_named_in(given)}
    # Of the config, not of the data: a set in these becomes a list there.
    for key, name in code_named_in(config.model_dump()):
        if name not in named:
            raise ConfigError(
                f"{source}: names code to run, {key}: {name!r}, which no file of data may do; if "
                f"you trust it, name it yourself: {key.partition('[')[0]}={name}"
            )
    return config


def _over_defaults(layers: Sequence[Layer]) -> Config:
    """The checked config of layers laid over the defaults. Raises ConfigError."""
    below = _defaults_under(_merged(layer.values for layer in layers))
    layers = [Layer(str(DEFAULTS), below), *layers]
    try:
        return Config.model_validate(_merged(layer.values for layer in layers))
    except ValidationError as error:
        raise ConfigError(explain(error, layers)) from error


def with_settings(config: Config, section: str, settings: Mapping[str, Any]) -> Config:
    """The config with some keys of one section changed, checked like everything else."""
    layers = [
        Layer("config", config.model_dump(mode="json")),
        Layer("keyword arguments", {section: dict(settings)}),
    ]
    try:
        return Config.model_validate(_merge(layers[0].values, layers[1].values))
    except ValidationError as error:
        raise ConfigError(explain(error, layers)) from error


def values_of(overrides: Sequence[str]) -> dict[str, Any]:
    """The nested values of dotted assignments. Raises ConfigError."""
    return _merged(_parse_override(text) for text in overrides)


def load_yaml(text: str) -> Any:
    """The plain data of a YAML text. Raises one of YAML_ERRORS, also for aliases: with these, a few
    lines stand for any amount of data."""
    return yaml.load(text, _Loader)  # a SafeLoader


def yaml_problem(error: Exception) -> str:
    """What one of YAML_ERRORS says, on one line: whoever names the file says where the text is."""
    return one_line(error).replace('in "<unicode string>", line', "in line")


def dump_config(config: Config) -> str:
    """The config as YAML that `load_config` reads back to an equal object."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False, allow_unicode=True)


def changed_keys(config: Config) -> list[str]:
    """Overrides that make `config` out of the defaults, e.g. for a command that repeats a run."""

    def changes(values: dict[str, Any], below: dict[str, Any], prefix: str) -> Iterator[str]:
        for name, value in values.items():
            if _is_section(f"{prefix}{name}"):
                yield from changes(value, below[name], f"{prefix}{name}.")
            elif value != below[name]:
                yield f"{prefix}{name}={json.dumps(value, ensure_ascii=False)}"  # JSON is YAML

    plain = config.model_dump(mode="json")
    noise, usual = plain["camera"]["depth_noise"], _defaults()["camera"]["depth_noise"]
    below = _defaults_under({"camera": {"depth_noise": noise}} if noise != usual else {})
    return list(changes(plain, Config.model_validate(below).model_dump(mode="json"), ""))


class _Loader(yaml.SafeLoader):
    """yaml.safe_load's loader, which also reads 3e-4 as a number, and refuses repeated keys and
    aliases."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.composer.ComposerError(
                None, None, f"an alias (*{event.anchor}) is not allowed", event.start_mark
            )
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(
                    None, None, "a key is no text", key.start_mark
                )
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key.value!r} stands twice", key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep)


# YAML 1.1 wants a dot and a signed exponent in a float and would read 3e-4 as text.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def read_config(path: Path) -> dict[str, Any]:
    """The plain data of a config file, whose keys are not checked. Raises ConfigError."""
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise ConfigError(f"{path}: has more than {LARGEST_FILE} bytes, this is no config file")
        values = load_yaml(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        near = did_you_mean(path.name, [p.name for p in path.parent.glob("*.y*ml")])
        raise ConfigError(f"{path}: no such config file{near or '; check the path'}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot read this config file: {error}") from error
    except ConfigError:
        raise
    except YAML_ERRORS as error:
        raise ConfigError(f"{path}: not valid YAML: {yaml_problem(error)}") from error
    if values is None:  # an empty file changes nothing
        return {}
    if not isinstance(values, dict):
        raise ConfigError(
            f"{path}: got a {type(values).__name__} at the top, expected 'key: value' lines as "
            f"in {DEFAULTS.name}"
        )
    return values


@cache
def _defaults() -> dict[str, Any]:
    """The values of `DEFAULTS`, read once, because that takes 50 ms; nobody changes them."""
    return read_config(DEFAULTS)


def _defaults_under(values: Mapping[str, Any]) -> dict[str, Any]:
    """The defaults under the keys that a user sets: who sets `camera.depth_noise` means this noise
    alone, and the default of `evaluate.depth_noises` gives way to it."""
    camera = values.get("camera")
    if isinstance(camera, dict) and "depth_noise" in camera:
        return _merge(_defaults(), {"evaluate": {"depth_noises": None}})
    return _defaults()


def _parse_override(text: str) -> dict[str, Any]:
    key, equals, raw = text.partition("=")
    key = key.strip()
    if not equals or not key:
        raise ConfigError(
            f"{text!r}: not an override, expected KEY=VALUE without spaces around =, such as "
            f"evaluate.rounds=50{'' if key in known_keys() else did_you_mean(key, known_keys())}"
        )
    schema = schema_at(key)
    if schema is None:
        raise ConfigError(unknown_key(key, "command line"))
    types = {part.get("type") for part in alternatives(schema)}
    try:
        value = load_yaml(raw)
        if "array" in types and not isinstance(value, list | dict | None):
            value = load_yaml(f"[{raw}]")
    except YAML_ERRORS as error:
        raise ConfigError(
            f"{key}: cannot read {raw!r} as YAML: {yaml_problem(error)}; expected {allowed(schema)}"
        ) from error
    named = value.items() if isinstance(value, dict) else ()
    if any(one is None and ":" in str(name) for name, one in named):
        raise ConfigError(f"{key}: {raw!r} lacks a space after a colon; expected {allowed(schema)}")
    if "string" in types and not isinstance(value, str | list | dict | None):
        value = raw.strip()  # evaluate.name=007 is text
    nested: Any = value
    for part in reversed(key.split(".")):
        nested = {part: nested}
    return nested


def _merge(base: Mapping[str, Any], top: Mapping[str, Any], section: str = "") -> dict[str, Any]:
    """`top` laid over `base`, both of a section (with a dot at its end): sections are merged, all
    else is replaced, also what maps names to numbers, such as the scales of env.reward."""
    merged = dict(base)
    for key, value in top.items():
        below, name = merged.get(key), f"{section}{key}"
        if isinstance(below, dict) and isinstance(value, dict) and _is_section(name):
            value = _merge(below, value, f"{name}.")
        merged[key] = value
    return merged


def _is_section(key: str) -> bool:
    return "properties" in (schema_at(key) or {})


def _merged(values: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    merged: dict[str, Any] = {}
    for top in values:
        merged = _merge(merged, top)
    return merged


def _without(values: Mapping[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    """`values` without some dotted keys of at most two parts."""
    kept = {name: dict(v) if isinstance(v, dict) else v for name, v in values.items()}
    for key in keys:
        section, _, leaf = key.partition(".")
        if not leaf:
            kept.pop(section, None)
        elif isinstance(kept.get(section), dict):
            kept[section].pop(leaf, None)
    return kept


# --- What is wrong with a config -------------------------------------------------------------


def _check_sections(layer: Layer) -> None:
    """Raise ConfigError where a file has a dotted key, or something else than keys as a section:
    laid over each other, such layers would hide which of them is wrong."""
    for name, value in layer.values.items():
        section, _, rest = str(name).partition(".")
        if rest and "properties" in (schema_at(section) or {}):
            raise ConfigError(
                f"{name}: dots are for the command line ({layer.source}); in a file, write "
                f"{section}: and below it, indented, {rest}: {_shown(value)}"
            )
        schema = schema_at(str(name)) or {}
        if "properties" in schema and not isinstance(value, dict):
            raise ConfigError(
                f"{name}: got {_shown(value)} ({layer.source}); expected {allowed(schema)}"
            )


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
        if "description" in schema:
            return schema["description"]
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
    elif not location and first["type"] == "value_error":
        message = str(first["ctx"]["error"])  # a rule between sections
    elif not location:
        message = f"{key or source}: {first['msg']}; keys are text as in {DEFAULTS.name}"
    else:
        known = ".".join(location)
        items = [] if first["type"] == "missing" else first["loc"]  # there is no such item
        index = "".join(f"[{part}]" for part in items if isinstance(part, int))
        schema = schema_at(known) or {}
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
