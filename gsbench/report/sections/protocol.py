"""How the runs were measured: every setting with its values, warnings where compared runs differ, and all runs."""

import shlex
from collections.abc import Iterator

import pandas as pd

from gsbench.errors import printable
from gsbench.measure.exact_views import sentence
from gsbench.measure.record import Record
from gsbench.report.frame import Results, without
from gsbench.report.section import Section, number, section

WARNING = "WARNING"
# What a record means that lacks a setting.
SILENT = {"resize": "area", "repaired": "none", "val_every": "none", "images": "floats", "reduced": "none"}
ELSEWHERE = "rendered elsewhere"  # what a setting of a training is of images that another program rendered
OF_ALL = {"machine": "machine", "commit": "git_commit", "versions": "versions"}  # the same for all scenes
# The scenes on which gsbench's own settings were chosen; what holds on them may not hold on others.
TUNED = frozenset(
    (
        "bouncingballs",
        "cloud",
        "moving-matte",
        "static-glossy",
        "static-matte",
        "suzanne",  # conf/exp/tuning.yaml
        "hook",
        "pendulum",
        "lego",
        "static-lego",
        "trex",
        "scene1_close_proximity",
        "scene4_occlusion",
        "scene7_deformation",
        "scene10_texture",
    )
)
TEXT = (
    "PSNR is over all pixels and channels of a view, after the final iteration, averaged over views; SSIM is that of "
    "scikit-image (Gaussian window, data_range 1). FPS is 1000 / the median milliseconds of a frame, with slicing and "
    "AGR. Minutes of training are without evaluation. Times of other machines than that of most runs, and of runs that "
    "shared a GPU, are left out."
)
DIFFER = " WARNING: runs that are compared differ in this."


@section(in_terminal=True)
def protocol(chapter: Results, tests: pd.DataFrame) -> Section:
    """Make the table of settings, so that a reader sees whether the runs can be compared.

    It warns of a setting in which runs of a scene differ, unless their variant names it: then the table compares it.

    It describes the finished runs whose settings most runs share. If no run finished, it describes the failed ones
    without a warning, because they may have stopped before their data was known.
    """
    ok = chapter.finished.runs
    runs = ok[ok.main] if len(ok) else chapter.runs
    columns = {name.removeprefix("protocol_"): name for name in sorted(runs) if name.startswith("protocol_")}
    columns.pop("paper_dataset", None)  # it names the paper's numbers to compare with, and changes no measurement
    columns |= {"iterations": "iterations", "data": "data_hash"} | OF_ALL
    rows = [row for setting, column in columns.items() for row in _setting(runs, setting, column, warn=len(ok) > 0)]
    rows += [["", *fact] for fact in _facts(runs)]
    table = pd.DataFrame(rows, columns=["note", "setting", "value", "scenes", "runs"])
    table = table.sort_values("note", ascending=False, kind="stable").reset_index(drop=True)
    words = TEXT + (DIFFER if (table.note == WARNING).any() else "")
    return Section("protocol", "Protocol, machine, seeds", words, table, notes=tuple(_notes(runs)))


def _setting(runs: pd.DataFrame, setting: str, column: str, *, warn: bool) -> Iterator[list[object]]:
    """Yield a row for each value of a setting, with its scenes and its number of runs, and whether it is a warning."""
    silent = SILENT.get(setting, "none" if runs[column].isna().all() else "not recorded")
    values = runs[column].map(lambda value: silent if value is None or value != value else _short(setting, value))
    compared = runs.variant.map(lambda variant: without(variant, setting) == variant)  # unless it names the setting
    if setting not in SILENT:
        is_trained = runs[column].notna() | ~runs.rendered_elsewhere
        values, compared = values.where(is_trained, ELSEWHERE), compared & is_trained
    by_scene = values[compared].groupby(runs.scene[compared]).nunique()
    is_mixed = (by_scene > 1).any() or (setting in OF_ALL and values.nunique() > 1)
    for value, runs_with in runs.groupby(values):
        note = WARNING if is_mixed and warn else ""
        yield [note, printable(setting), value, _scenes(runs_with, runs), len(runs_with)]


def _short(setting: str, value: object) -> str:
    """Return a value as text: iterations without decimals, the first digits of a hash, and "-dirty" of a commit."""
    text = printable(f"{value:g}" if isinstance(value, float) and value < 1e15 else value)
    if setting == "iterations":
        text = number(float(text), 0)
    if setting not in ("commit", "data") or " " in text:  # words such as "not recorded"
        return text
    digits, dash, dirty = text.partition("-") if setting == "commit" else (text, "", "")
    return f"{digits[:12]}{dash}{dirty}"


def _facts(runs: pd.DataFrame) -> Iterator[list[object]]:
    """Yield what else the numbers depend on: name, value, scenes and number of runs."""
    yield ["seeds", ", ".join(map(str, sorted(runs.seed.unique()))), "all", len(runs)]
    early = [r.stop.kept if r.stop and r.stop.kept < r.stop.iteration else None for r in runs.record]
    chosen = [r.length_choice.kept if r.length_choice else None for r in runs.record]
    facts = (
        ("load of the machine, with the run itself", runs.load.where(runs.machine == runs.timed_on), 1),
        ("most that float32 changes PSNR of a view, dB", runs.psnr_float32_db, 6),
        ("measured at the best iteration on val (train.patience)", early, 0),
        ("iterations of averaged parameters (train.average_from)", runs.averaged.where(runs.averaged > 0), 0),
        ("iterations chosen on val; times are those of all lengths (train.lengths)", chosen, 0),
    )
    for name, values, digits in facts:
        recorded = pd.Series(values, runs.index, dtype=float).dropna()
        if len(recorded):
            ends = dict.fromkeys(number(value, digits) for value in (recorded.min(), recorded.max()))
            yield [name, " to ".join(ends), _scenes(runs.loc[recorded.index], runs), len(recorded)]


def _scenes(some: pd.DataFrame, runs: pd.DataFrame) -> str:
    """Name the scenes of some of the runs."""
    names = sorted(some.scene.unique())
    return "all" if len(names) == runs.scene.nunique() else ", ".join(names)


def _notes(runs: pd.DataFrame) -> Iterator[str]:
    """Yield what a reader must know of some scenes and commits."""
    if runs.git_commit.fillna("").str.endswith("-dirty").any():
        yield "WARNING: files were changed after the commit (-dirty), which does not reproduce these numbers."
    if runs.seed.nunique() == 1:
        yield "An interval (±) needs several seeds, such as seed=0,1,2."
    if "protocol_eval_split" in runs and ((runs.scene == "lego") & (runs.protocol_eval_split == "val")).any():
        yield "lego is measured on val: the test split of D-NeRF's lego contradicts its motion."
    if tuned := sorted(TUNED & set(runs.scene)):
        yield f"gsbench's own settings were tuned on {', '.join(tuned)} (docs/tuning.md)."
    if exact_views := sorted({view for r in runs.record for view in r.exact}):
        yield printable(sentence(exact_views))


@section()
def runs(chapter: Results, tests: pd.DataFrame) -> Section:
    """Make the table of every run, with why it failed and the command that repeats it."""
    all_runs = chapter.runs
    table = all_runs[["status", "psnr_db", "train_s", "train_cpu_s", "load", "frame_ms", "model_mb", "iterations"]]
    table = table.assign(
        load=all_runs.load.where(all_runs.machine == all_runs.timed_on),
        commit=[_short("commit", value or "not recorded") for value in all_runs.git_commit],
        command=all_runs.record.map(command),
        reason=all_runs.reason,
    )
    text = "A time is empty if the run was on another machine than most, or shared its GPU."
    table.insert(0, "run", [record.path.as_posix() for record in all_runs.record])
    if "contributor" in all_runs:
        table.insert(1, "contributor", all_runs.contributor)
    table = table.sort_values("status", key=lambda status: status == "ok", kind="stable")
    table = table if (all_runs.status != "ok").any() else table.drop(columns="reason")
    return Section("runs", "Every run", text, table.reset_index(drop=True), folded=True)


def command(record: Record) -> str:
    """Return the command that repeats a run; "" if its record does not hold it."""
    words = " ".join(shlex.quote(printable(word)) for word in record.overrides)
    return f"python -m gsbench {words}" if words else ""
