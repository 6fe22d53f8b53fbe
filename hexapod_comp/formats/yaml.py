"""Strict reading and readable writing of YAML files; :mod:`.schema` interprets the keys."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from ..errors import InputFileError, shorten
from .files import read_text
from .schema import Section

# Deepest allowed nesting, levels; a model has five, and the parser's stack overflows at some thousands
MAX_DEPTH = 32

# Largest number of values, keys and lists in a YAML file; each of them takes 10 µs and 600 bytes. A model with an error
# field of 20 × 20 lines along each axis, for both directions, and polynomials of the fifth order has 120,000.
MAX_NODES = 200_000

# Numbers that YAML 1.1 reads differently from a person: 0400 as 256, 1:30 as 90, 0x10 as 16
AMBIGUOUS_NUMBER = re.compile(r"[-+]?0[0-9A-Za-z]|.*[:_]")


class _StrictLoader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """A YAML loader for plain values that refuses ambiguous numbers, and mappings in which a key is given twice."""


def _mapping_without_duplicates(loader: Any, node: yaml.MappingNode) -> dict:
    seen: set[Any] = set()
    for key_node, _ in node.value:
        key = loader.construct_object(key_node, deep=True)
        if not isinstance(key, str):
            raise _yaml_error(f"key {shorten(key)} is not text", key_node)
        if key in seen:
            raise _yaml_error(f"key {shorten(key)} is given twice", key_node)
        seen.add(key)
    return loader.construct_mapping(node, deep=True)


def _yaml_error(problem: str, node: yaml.Node | yaml.Event) -> yaml.YAMLError:
    """Return (do not raise) a YAML error with a problem and the position of a node in the text."""
    return yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


def _plain_number(loader: Any, node: yaml.ScalarNode) -> int | float:
    text = loader.construct_scalar(node)
    if AMBIGUOUS_NUMBER.match(text):
        raise _yaml_error(f"{shorten(text)} is not a plain decimal number", node)
    try:
        return int(text) if node.tag.endswith(":int") else loader.construct_yaml_float(node)
    except ValueError as error:  # Python converts no whole number of more than 4300 digits
        raise _yaml_error(f"{shorten(text)} is too long for a number", node) from error


def _date(loader: Any, node: yaml.ScalarNode) -> Any:
    try:
        return loader.construct_yaml_timestamp(node)
    except ValueError as error:
        raise _yaml_error(f"{shorten(node.value)} is no date: {error}", node) from error


_StrictLoader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping_without_duplicates)
_StrictLoader.add_constructor("tag:yaml.org,2002:timestamp", _date)
for _tag in ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float"):
    _StrictLoader.add_constructor(_tag, _plain_number)


def read_yaml(path: str | Path, file_format: str, version: int) -> Section:
    """Read a YAML file as a Section; refuse a file that states another `format` or `version`."""
    return parse_yaml(read_text(path), path, file_format, version)


def parse_yaml(text: str, name: str | Path, file_format: str, version: int) -> Section:
    """Read a YAML text as a Section; refuse a text that states another `format` or `version`."""
    content = yaml_content(text, name)
    if not isinstance(content, dict):
        raise InputFileError(name, "", "must hold keys and values at its top level", content)
    section = Section(name, "", content)
    given = section.text("format")
    if given != file_format:
        raise section.error("format", f"must be {file_format!r}", given)
    given_version = section.require("version")
    if type(given_version) is not int or given_version != version:
        raise section.error("version", f"must be {version}, the only version that this program reads", given_version)
    return section


def yaml_content(text: str, name: str | Path, most_nodes: int = MAX_NODES) -> Any:
    """Return the values, lists and mappings of a YAML text; refuse a text with more than `most_nodes` values."""
    try:
        _reject_aliases_and_tags(text, most_nodes)
        return yaml.load(text, Loader=_StrictLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        problem = getattr(error, "problem", None) or type(error).__name__
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}" if mark is not None else ""
        if mark is not None and "".join(text.split("\n")[mark.line : mark.line + 1]).lstrip(" ").startswith("\t"):
            problem += "; YAML is indented by spaces, not by tabs"
        raise InputFileError(name, where, f"is not valid YAML: {problem}") from error


def _reject_aliases_and_tags(text: str, most_nodes: int) -> None:
    """Raise a YAML error for an alias, a tag, more than `most_nodes` values or more than MAX_DEPTH levels."""
    # Nested aliases (`*name`) in a short file can expand to more values than fit into memory. Deep nesting overflows
    # the parser's stack and ends the process. A tag (`!!float`) makes the loader read a value as another type.
    depth = nodes = 0
    for event in yaml.parse(text, Loader=_StrictLoader):
        if isinstance(event, yaml.AliasEvent):
            raise _yaml_error(f"reference *{event.anchor} is not understood; write the value out", event)
        if getattr(event, "tag", None) is not None:
            raise _yaml_error(f"tag {shorten(event.tag)} is not understood; write the plain value", event)
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        nodes += isinstance(event, yaml.NodeEvent)
        if nodes > most_nodes:
            raise _yaml_error(f"contains more than the allowed {most_nodes} values", event)
        if depth > MAX_DEPTH:
            raise _yaml_error(f"is nested deeper than the allowed {MAX_DEPTH} levels", event)


LONGEST_LINE = 2**30  # length at which the writer wraps a line, characters; LibYAML does not accept infinity


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """A YAML writer without aliases that puts each list of plain values on one line, all other content into blocks."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_list(dumper: yaml.SafeDumper, data: list) -> yaml.Node:
    row = not any(isinstance(item, list | dict) for item in data)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=row)


_Dumper.add_representer(list, _represent_list)


def block_text(content: dict[str, Any]) -> str:
    """Return content as YAML text: keys keep their order, and each list of numbers is on one line."""
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=LONGEST_LINE))
