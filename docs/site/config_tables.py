"""Write the tables of docs/config.md: every key of the config with its facts."""

import inspect
import math
from typing import Any

from gsbench.config import Config
from gsbench.config_key import ENDLESS, REQUIRED, Key, declared, described

HEAD = "key | default | range | meaning\n--- | --- | --- | ---"


def tables() -> str:
    """Return a heading, the purpose and a table of keys for each group of the config."""
    groups: dict[str, dict[str, Key]] = {}
    for name, facts in declared(Config).items():
        groups.setdefault(name.rpartition(".")[0], {})[name] = facts
    return "\n\n".join(_group(name, keys) for name, keys in groups.items())


def _group(name: str, keys: dict[str, Key]) -> str:
    about = described(Config, name) if name else Key(kind=Config)
    rows = [f"`{key}` | {_default(facts)} | {_range(facts)} | {facts.help}" for key, facts in keys.items()]
    purpose = about.help or inspect.getdoc(about.kind) or ""
    return "\n\n".join([f"## {name or 'The run'}", purpose, "\n".join([HEAD, *rows])])


def _default(facts: Key) -> str:
    """Show the default of a key as YAML has it, or its type where the default does not tell it."""
    kind = getattr(facts.kind, "__name__", str(facts.kind)) if isinstance(facts.kind, type) else str(facts.kind)
    if facts.default == REQUIRED:
        return kind
    if facts.default is None:
        return f"`null`, {kind.removesuffix(' | None')}".replace("|", "or")
    words: dict[Any, str] = {True: "true", False: "false", "": "''"}
    is_word = isinstance(facts.default, bool | str) and facts.default in words
    return f"`{words[facts.default] if is_word else facts.default}`{facts.unit and f' {facts.unit}'}"


def _range(facts: Key) -> str:
    if facts.choices or facts.low == -math.inf:
        return ", ".join(facts.choices)
    return f"{facts.low:g}–{facts.high:g}" if facts.high < ENDLESS else f"≥{facts.low:g}"
