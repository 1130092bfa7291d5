"""Write the tables of docs/config.md: every key of the config with its facts."""

import inspect

from gsbench.config import Config
from gsbench.config_key import Key, declared, described

HEAD = "key | default | meaning\n---|---|---"


def tables() -> str:
    """Return a heading, the purpose and a table of keys for each group of the config."""
    groups: dict[str, dict[str, str]] = {}
    for name, facts in declared(Config).items():
        group = name.partition(".")[0] if "." in name else ""
        rows = groups.setdefault(group, {})
        cells = " | ".join(("", *cells_of(facts)))
        alike = next((key for key in rows if rows[key] == cells and is_alike(key, name)), name)
        rows[merged(alike, name)] = rows.pop(alike, cells)
    return "\n\n".join(
        "\n".join([*heading(group), HEAD, *(f"`{name}`{cells}" for name, cells in rows.items())])
        for group, rows in groups.items()
    )


def heading(group: str) -> list[str]:
    """Return the title of a group and what it is for."""
    about = inspect.getdoc(described(Config, group).kind if group else Config) or ""
    return [f"## {group or 'The run'}", "", about, ""]


def cells_of(facts: Key) -> tuple[str, str]:
    """Return the default of a key, and its meaning with its range."""
    allowed = facts.range.replace("at least ", "≥").replace(" to ", "–")
    default = f"`{facts.shown}`" if facts.shown else "required"
    return f"{default} {facts.unit}".strip(), f"{facts.help} ({allowed})" if allowed else facts.help


def is_alike(first: str, second: str) -> bool:
    """Return whether two keys with equal facts are of groups beside each other, such as two penalties."""
    before, after = first.split("."), second.split(".")
    return len(before) == len(after) > 2 and (before[:-2], before[-1]) == (after[:-2], after[-1])


def merged(first: str, second: str) -> str:
    """Return one name for alike keys: `train.penalties.opacity|size.weight`."""
    if first == second:
        return first
    *group, names, last = first.split(".")
    return ".".join([*group, f"{names},{second.split('.')[-2]}", last])
