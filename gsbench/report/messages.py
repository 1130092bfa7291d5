"""Format numbers, intervals and names for the sentences of the HTML report."""

import math
import shlex

from gsbench.errors import printable
from gsbench.measure.record import Record
from gsbench.report.intervals import Estimate

LONGEST = 300  # characters of a text from a record
SEEDS = (0, 1, 2)  # the fewest seeds whose interval is of use


def shorten(text: object, longest: int = LONGEST) -> str:
    """Return a text on one line, with control characters escaped, cut to at most `longest` characters."""
    line = printable(str(text)[: 4 * longest])
    return line if len(line) <= longest else f"{line[: longest - 1]}…"


def shorten_middle(text: str, longest: int, tail: int) -> str:
    """Shorten a text to `longest` characters: its middle is cut out and its last `tail` characters stay."""
    line = shorten(text)
    return line if len(line) <= longest else f"{line[: longest - tail - 1].rstrip()}…{line[-tail:]}"


def listing(words: list[str], last: str = "and") -> str:
    """Join words into a list such as "a", "a and b" or "a, b and c"."""
    return f"{', '.join(words[:-1])} {last} {words[-1]}" if len(words) > 1 else "".join(words)


def sentence(text: str) -> str:
    """Return a text with a capital first letter; the other letters stay unchanged."""
    return text[:1].upper() + text[1:]


def count(number: int, what: str) -> str:
    """Return a number with a noun in the singular or plural, such as "1 run" or "2 runs"."""
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def plain(value: float, digits: int = 2) -> str:
    """Format a number with a typographic minus sign; return a dash for NaN."""
    return "–" if math.isnan(value) else f"{value:.{digits}f}".replace("-", "−")


def probability(p: float) -> str:
    """Format a p-value with three digits, or as "< 0.001" if it is smaller than that."""
    return "< 0.001" if p < 0.001 else plain(p, 3)


def signed(value: float, digits: int = 2) -> str:
    """Format a difference with its sign; a difference that rounds to zero has no sign."""
    text = plain(value, digits)
    if math.isnan(value) or float(text.replace("−", "-")) == 0:
        return text.removeprefix("−")
    return text if text.startswith("−") else f"+{text}"


def duration(seconds: float) -> str:
    """Format a time in seconds, minutes or hours, such as "8.3 s" or "2.5 h"; return "never" if it is infinite."""
    if math.isnan(seconds):
        return "–"
    if math.isinf(seconds):
        return "never"
    if seconds < 100:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def budget(seconds: float) -> str:
    """Format a time budget in seconds or minutes, such as "10 s" or "1 min"."""
    return f"{seconds:g} s" if seconds < 60 else f"{seconds / 60:g} min"


def interval(of: Estimate, digits: int = 2, *, sign: bool = False) -> str:
    """Format a 95 % interval and say whether it is over seeds, views or scenes; "" if there is none."""
    write = signed if sign else plain
    return f"95 % {write(of.low, digits)} to {write(of.high, digits)} over {of.over}" if of.over else ""


def in_brackets(*words: str) -> str:
    """Join the words that are not empty by semicolons, in brackets and after a space; "" if all are empty."""
    known = "; ".join(filter(None, words))
    return f" ({known})" if known else ""


def over(of: Estimate) -> str:
    """Say whether an interval holds for similar scenes, or only for other seeds and views of the same scenes."""
    return {"scenes": "scenes like these", "": "–"}.get(of.over, f"{of.over}, on {count(of.scenes, 'scene')}")


def scope(of: Estimate) -> str:
    """Return a sentence with the number of compared scenes, which also says whether intervals hold for other scenes."""
    scenes = {1: "One scene", 2: "Two scenes"}.get(of.scenes, count(of.scenes, "scene"))
    if not of.over:
        return f"{scenes}, without an interval."
    if of.over == "scenes":
        return f"{scenes}. The intervals are for scenes like these."
    these = "this scene" if of.scenes == 1 else "these scenes"
    return f"{scenes}. The intervals are for other {of.over} of {these}. Another scene may differ by more."


def more_seeds(records: list[Record]) -> str:
    """Return the command that runs the given runs with more seeds; "" if the records do not hold their settings.

    If the runs differ in more than the values of the same settings, the command is that of the first run.
    """
    told = [dict(word.partition("=")[::2] for word in r.overrides) for r in records if r.overrides]
    if not told:
        return ""
    alike = all(one.keys() == told[0].keys() and not any("," in value for value in one.values()) for one in told)
    values = {key: list(dict.fromkeys(one[key] for one in (told if alike else told[:1]))) for key in told[0]}
    values["seed"] = [str(seed) for seed in sorted({r.seed for r in records} | set(SEEDS))]
    words = [f"{key}={','.join(several)}" for key, several in values.items()]
    return f"python -m gsbench -m {' '.join(shlex.quote(shorten(word)) for word in words)}"


def run_name(record: Record) -> str:
    """Return the name of a run: the path of its folder."""
    return record.path.as_posix()


def command(records: list[Record]) -> str:
    """Return the command that repeats the given runs.

    If the runs differ in more than the seed, the command repeats only the first one.
    """
    if not all(r.overrides for r in records):
        return ""
    rest = {tuple(o for o in r.overrides if not o.startswith("seed=")) for r in records}
    if len(records) > 1 and len(rest) == 1:
        words = ["-m", *rest.pop(), f"seed={','.join(str(r.seed) for r in records)}"]
    else:
        words = list(records[0].overrides)
    return f"python -m gsbench {' '.join(shlex.quote(shorten(word)) for word in words)}"
