"""YAML as plain data, of texts that cannot take more time or memory than their length is worth."""

from typing import Any

import yaml

MAX_CHARACTERS, MAX_DEPTH = 100_000, 30


def parse_yaml(text: str) -> Any:
    """The value that a YAML text writes: dicts, lists, strings, numbers, booleans, dates or None.

    Raises:
        yaml.YAMLError: no valid YAML, or YAML with what settings do not need: aliases (ten lines of them can stand for
            more values than memory holds), a key that is given twice, nesting of more than MAX_DEPTH levels.
        ValueError: more than MAX_CHARACTERS, or a number or date that there is not.
    """
    if len(text) > MAX_CHARACTERS:
        raise ValueError(f"{len(text)} characters, at most {MAX_CHARACTERS} are read")
    return yaml.load(text, Loader=_Loader)  # noqa: S506  # a SafeLoader


class _Loader(yaml.SafeLoader):
    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError(f"line {self.peek_event().start_mark.line + 1}: an alias; write the value itself")
        if self.depth == MAX_DEPTH:
            raise yaml.YAMLError(f"line {self.peek_event().start_mark.line + 1}: nested deeper than {MAX_DEPTH} levels")
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[tuple[str, str]] = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            name = (key.tag, str(key.value))
            if name in seen:
                raise yaml.YAMLError(f"line {key.start_mark.line + 1}: the key {name[1]} is given twice")
            seen.add(name)
        return super().construct_mapping(node, deep)
