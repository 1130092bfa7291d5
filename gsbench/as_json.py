"""Print the result of a command as JSON, in which an unknown number is null."""

import json
import math
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any


def as_json(result: Any) -> str:
    """Return a result as JSON text.

    Args:
        result: dicts, lists, dataclasses, texts, numbers and paths. NaN and infinity become null.
    """
    return json.dumps(_plain(result), indent=1, allow_nan=False)


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
