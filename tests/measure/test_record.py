"""The record: what is written is read back, what is damaged is refused with one line that names the place."""

import dataclasses
import json
import math
import os
import random
import subprocess
from importlib import metadata
from pathlib import Path

import pytest
import torch
from forked import ended, python
from hostile.mutations import damage_file
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from report.records import make
from tiny_run import ROOT

from gsbench import kernels
from gsbench.errors import InputError, one_line
from gsbench.launch import status as launched
from gsbench.measure import machine
from gsbench.measure import record as files
from gsbench.measure.atomic import write_atomically
from gsbench.measure.curve import Point
from gsbench.measure.provenance import git_commit, provenance, versions
from gsbench.measure.record import METRICS, ViewScore


def refused(path: Path, *words: str) -> None:
    """The file is refused by an InputError of one line that names it and every one of `words`."""
    with pytest.raises(InputError) as caught:
        files.read(path)
    message = str(caught.value)
    assert "\n" not in message
    for word in (str(path), *words):
        assert word in message


measured = st.floats(-1e100, 1e100)
texts = st.text(st.characters(codec="utf-8"), max_size=20)
plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63) + 1, 2**63 - 1) | measured | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=8,
)


def test_a_package_that_is_missing_hides_no_other(monkeypatch):
    """Would catch versions that end at the first package that is not installed, such as LPIPS."""
    known, version = versions(), metadata.version
    assert {"python", "gsbench", "torch", "numpy", "lpips", "opencv-contrib-python-headless"} <= known.keys()

    def without(package: str) -> str:
        if package == "numpy":
            raise metadata.PackageNotFoundError(package)
        return version(package)

    monkeypatch.setattr(metadata, "version", without)
    assert versions() == {name: value for name, value in known.items() if name != "numpy"}


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    metrics=st.dictionaries(st.sampled_from(METRICS), measured),
    config=st.dictionaries(texts, plain, max_size=4),
    reason=texts,
    seconds=st.lists(measured, max_size=4),
    seed=st.integers(0, 2**63 - 1),
)
def test_what_is_written_is_read_back(tmp_path, metrics, config, reason, seconds, seed):
    """Would catch a field that is lost, converted or rounded on its way through the file."""
    curve = [Point(i, s, None) for i, s in enumerate(seconds)]
    record = make(status="failed", reason=reason, metrics=metrics, missing={}, curve=curve, seed=seed)
    record = dataclasses.replace(record, provenance=dataclasses.replace(record.provenance, config=config))
    files.write(record, tmp_path / "record.json")
    assert files.read(tmp_path / "record.json") == record


@pytest.mark.parametrize(("value", "why"), [(math.inf, "identical"), (math.nan, "not a number")])
def test_a_metric_that_is_not_finite_becomes_null_with_its_reason(tmp_path, value, why):
    """Would catch NaN or Infinity in the file, which is not JSON, or a null that nobody can explain."""
    path = tmp_path / "record.json"
    views = [ViewScore("a", value, value, 1.0)]
    files.write(make(metrics={"psnr": value}, missing={}, per_view=views, curve=[Point(1, 1.0, value)]), path)
    assert "Infinity" not in path.read_text()
    assert "NaN" not in path.read_text()
    read = files.read(path)
    assert read.metrics == {"psnr": None}
    assert why in read.missing["psnr"]
    assert read.per_view[0].psnr is None
    assert read.per_view[0].ssim == 1.0
    assert read.curve == [Point(1, 1.0, None)]


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"status": "fine"}, "status"),
        ({"status": "failed"}, "reason"),
        ({"reason": "but why"}, "reason"),
        ({"metrics": None, "missing": {}}, "metrics"),
        ({"cost": None}, "cost"),
        ({"metrics": {"pnsr": 1.0}, "missing": {}}, "Did you mean 'psnr'"),
        ({"missing": {}}, "lpips_vgg"),
        ({"missing": {"lpips_vgg": "no weights", "psnr": "it is there"}}, "missing"),
        ({"scene": "../other"}, "scene"),
        ({"seed": -1}, "seed"),
        ({"protocol": {"far": math.inf}}, "protocol.far"),
        ({"protocol": {"path": Path("x")}}, "plain JSON"),
        ({"curve": [Point(2, 1.0, None), Point(1, 2.0, None)]}, "curve"),
        ({"curve": [Point(i, float(i), 20.0) for i in range(10_001)]}, "curve: expected array"),
        ({"version": 2}, "version"),
        ({"seed": "0"}, "seed"),
        ({"effects": {"time": True}}, "effects: object missing required field direction"),
        ({"effects": None}, "effects: expected a value in a run of gsbench's"),
        (
            {"cost": dataclasses.replace(make().cost, train_s=None)},
            "cost.train_s: expected a value in a run of gsbench's",
        ),
    ],
)
def test_what_read_would_refuse_is_not_written(tmp_path, changes, word):
    """Would catch a record that is written and can never be read again, and a fault that does not name its field."""
    path = tmp_path / "record.json"
    with pytest.raises(InputError, match=word):
        files.write(dataclasses.replace(make(), **changes), path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (["surprise"], 1, ["surprise", "unknown key"]),
        (["scnee"], "x", ["Did you mean 'scene'"]),
        (["cost", "render_ms", "p50"], "2", ["cost.render_ms.p50", "expected float, got str"]),
        (["cost", "render_ms", "p50"], True, ["cost.render_ms.p50"]),
        (["cost", "num_gaussians"], 1.0, ["cost.num_gaussians", "expected int | null, got float"]),
        (["seed"], 2**63, ["seed"]),
        (["seed"], True, ["seed", "expected int, got bool"]),
        (["effects", "time"], 1, ["effects.time", "expected bool, got int"]),
        (["per_view", 0, "ssim"], [], ["per_view[0].ssim"]),
        (["curve", 1], [1, 2], ["curve[1]", "expected array of length 3, got 2"]),
        (["curve", 1, 0], 0.5, ["curve[1][0]"]),
        (["curve"], [[i, i, 20] for i in range(100_000)], ["curve: expected array of length <= 10000"]),
        (["provenance", "versions", "python"], None, ["provenance.versions", "expected str, got null"]),
        (["model"], "\ud800", ["model", "Unicode"]),
        (["per_view", 0, "name"], "\ud800", ["per_view[0].name", "Unicode"]),
        (["version"], 2, ["version", "expected 1"]),
        (["version"], True, ["version"]),
        (["version"], 1.0, ["version"]),
        (["cost", "fps"], 10**400, ["cost.fps"]),
        (["cost", "fps"], math.nan, ["finite"]),  # which Python writes and reads, and JSON does not know
        (["cost", "fps"], -math.inf, ["finite"]),
        (["metrics", "psnr"], 1e308, ["metrics.psnr", "at most 1e+100"]),  # which no chart can have on an axis
    ],
)
def test_a_wrong_value_is_refused_by_name(tmp_path, place, value, words):
    """Would catch a reader that converts ("2" to 2, true to 1), lets a key through, or does not say where."""
    path = tmp_path / "record.json"
    files.write(make(), path)
    whole = json.loads(path.read_text())
    inner = whole
    for step in place[:-1]:
        inner = inner[step]
    inner[place[-1]] = value
    path.write_text(json.dumps(whole))
    refused(path, *words)


NO_RECORDS = [b"", b"{", b"[]", b"null", b"\xff\xfe", b"[" * 100_000, b'{"version": 1}', b'{"version": NaN}']
NO_RECORDS += [b'{"version": 1, "version": 1}', b'{"version": ' + b"9" * 5000 + b"}"]


@pytest.mark.parametrize("text", NO_RECORDS)
def test_what_is_no_record_is_refused(tmp_path, text):
    """Would catch a stack trace (RecursionError, UnicodeDecodeError, KeyError) on a file that is not a record."""
    path = tmp_path / "record.json"
    path.write_bytes(text)
    refused(path)


def test_a_damaged_record_is_read_or_refused(tmp_path):
    """Would catch any exception but InputError, a message of several lines, and a record that is read and cannot be
    written again: JSON of any values, truncated and changed bytes, keys twice, links, folders and pipes for files."""
    refusals = 0
    for seed in range(400):
        path = tmp_path / str(seed) / "record.json"
        files.write(make(), path)
        damage_file(random.Random(seed), path)
        try:
            record = files.read(path)
        except InputError as error:
            assert str(error).isprintable()  # noqa: PT017  # reading well is fine, too
            assert str(path) in str(error)  # noqa: PT017
            refusals += 1
        else:
            files.write(record, tmp_path / "again.json")
            assert files.read(tmp_path / "again.json") == record
    assert 200 < refusals < 400


def test_a_failure_while_writing_leaves_the_old_record(tmp_path, monkeypatch):
    """Would catch a writer that empties the file first: a full disk would then cost a finished run."""
    path = tmp_path / "record.json"
    files.write(make(), path)
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError("no space left")))
    with pytest.raises(OSError, match="no space"):
        files.write(make(seed=5), path)
    assert files.read(path) == make()
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_of_a_file_names_it_and_nothing_else(tmp_path):
    """Catches "[Errno 28] No space left on device: 'x' -> None" or -> another name, and that of the temporary file."""
    with pytest.raises(OSError, match="director") as raised:
        write_atomically(tmp_path, b"")
    assert str(raised.value) == f"[Errno {raised.value.errno}] {raised.value.strerror}: '{tmp_path}'"
    assert one_line(raised.value) == f"{tmp_path}: {raised.value.strerror}"


def test_paths_say_what_a_run_is_and_cannot_leave_the_root(tmp_path):
    """Would catch a scene named "../.." writing outside the results, and a layout that `find` does not find."""
    folder = files.run_path(tmp_path, "mini", "suzanne", "7dgs", 3)
    assert folder == tmp_path / "mini" / "suzanne" / "7dgs" / "seed3"
    files.write(make(seed=3), folder / files.FILE_NAME)
    assert files.find(tmp_path) == [folder / "record.json"]
    assert make(variant="iterations=9").path == Path("mini/suzanne/7dgs,iterations=9/seed0")
    for name in ("..", ".", "", "a/b", "a\\b", ".hidden", "a\n", "a b", "-x"):
        with pytest.raises(InputError, match="scene"):
            files.run_path(tmp_path, "mini", name, "7dgs", 0)
    with pytest.raises(InputError, match="seed"):
        files.run_path(tmp_path, "mini", "suzanne", "7dgs", -1)


def test_provenance_names_the_machine_and_hashes_the_config(tmp_path, monkeypatch):
    """Would catch a hash that depends on the order of keys, an unwritable field, and a lost instruction set."""
    monkeypatch.setattr(torch.cuda, "get_device_name", {"cuda:1": "a GPU"}.get)
    monkeypatch.setattr(kernels, "instruction_set", lambda: "v3")
    first = provenance({"a": 1, "b": [2]}, None, "cpu")
    two = provenance({"b": [2], "a": 1}, None, "cuda:1")
    other = provenance({"a": 1, "b": [3]}, None, "cpu")
    assert first.config_hash == two.config_hash != other.config_hash
    assert first.device
    assert two.device == "a GPU"
    assert first.versions["torch"]
    assert first.hardware.instruction_set == "v3"
    assert first.time.endswith("+00:00")
    files.write(make(provenance=first), tmp_path / "record.json")
    assert files.read(tmp_path / "record.json").provenance == first


def test_published_records_are_passed_by_unless_they_are_named(tmp_path):
    """Would catch our numbers in a stranger's table, as his, and published records that cannot be read at all."""
    measured, published_at = (root / "mini/suzanne/7dgs/seed0" for root in (tmp_path, tmp_path / files.PUBLISHED))
    for folder in (measured, published_at):
        files.write(make(), folder / files.FILE_NAME)
    assert files.find(tmp_path) == [measured / files.FILE_NAME]
    assert launched.read(tmp_path).records_by_path.keys() == {measured / files.FILE_NAME}
    for root in (tmp_path / files.PUBLISHED, tmp_path / files.PUBLISHED / "mini"):
        assert files.find(root) == [published_at / files.FILE_NAME]


def test_git_ignores_what_this_machine_measured_and_nothing_that_is_published():
    """Would catch `make table1` that changes tracked files, and a published record that is not committed."""
    if not (ROOT / ".git").exists():
        pytest.skip("gsbench is not in a git checkout here")
    ignored = [f"results/{name}" for name in ("table1.md", "mini/table.md", "mini/suzanne/7dgs/seed0/record.json")]
    ignored.append("results/published/new/table.csv")
    ours = [f"results/published/{name}" for name in ("new/table.md", "new/runs.csv", "new/views.csv.gz")]
    assert ended("git", "check-ignore", *ignored, *ours, cwd=ROOT).stdout.split() == ignored


def test_a_record_has_the_commit_of_the_code_that_ran(monkeypatch):
    """Would catch a commit that was made during a long training, and that its record says instead."""
    first = provenance({}, None, "cpu").git_commit
    monkeypatch.setattr("gsbench.measure.provenance.git_commit", lambda: "made since")
    assert provenance({}, None, "cpu").git_commit == first


def test_records_and_tables_do_not_import_torch():
    """Would catch two seconds of importing torch before a table is printed, and a table that needs torch at all."""
    code = (
        "import sys, gsbench.measure.record, gsbench.measure.speed, gsbench.report.output, gsbench.measure.images;"
        "from gsbench.measure.provenance import versions; versions();"
        "sys.exit('torch' in sys.modules)"
    )
    assert python("-c", code).returncode == 0


def test_results_make_no_commit_dirty(tmp_path, monkeypatch):
    """Catches the commit of the folder a run was started in, records called dirty because another's was written over,
    changed or new code that is not, and a run without git that ends in an exception."""
    place = tmp_path / "gsbench/measure/provenance.py"
    for path in (place, tmp_path / "results/record.json", tmp_path / "README.md"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("1")
    for words in (["init", "-q"], ["add", "-A"], ["-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "x"]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    monkeypatch.setattr("gsbench.measure.provenance.__file__", str(place))
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=tmp_path, capture_output=True, text=True, check=True)
    clean = git_commit()
    assert clean == head.stdout.strip()
    (tmp_path / "results/record.json").write_text("2")
    (tmp_path / "README.md").write_text("2")
    (tmp_path / "data.npy").write_text("2")
    assert git_commit() == clean
    added = tmp_path / "gsbench/balls.py"
    added.write_text("1")
    assert git_commit() == f"{clean}-dirty"
    added.unlink()
    place.write_text("2")
    assert git_commit() == f"{clean}-dirty"
    monkeypatch.setenv("PATH", "")
    assert git_commit() is None


@pytest.fixture
def system(tmp_path, monkeypatch):
    """Write what the system says of a machine, and return the machine that is read from it."""

    def read(cpuinfo, memory="24684092 kB", **more):
        for name, text in (("CPUINFO", cpuinfo), ("MEMINFO", f"MemTotal:       {memory}\nMemFree: 1 kB\n")):
            (tmp_path / name).write_text(text)
            monkeypatch.setattr(machine, name, tmp_path / name)
        monkeypatch.setattr(os, "cpu_count", lambda: 2)
        return machine.hardware(**more)

    return read


EPYC = "processor\t: {n}\ncpu family\t: {family}\nmodel\t\t: 1\nmodel name\t: AMD EPYC\nstepping\t: 1\n\n"


def test_a_machine_is_what_seconds_depend_on(system):
    """Would catch generations of EPYC that pool silently, whose seconds differ as their names do not, "1 threads", a
    machine that is another after each boot, and a run lost for want of a family, on aarch64 or without /proc."""
    zen3, zen5 = (system("".join(EPYC.format(n=n, family=f) for n in range(2)), instruction_set="v3") for f in (25, 26))
    assert str(zen3) == "AMD EPYC family 25 model 1 stepping 1, 2 cores, v3, 24 GiB"
    assert str(zen5) == "AMD EPYC family 26 model 1 stepping 1, 2 cores, v3, 24 GiB"
    of = dataclasses.replace(make().provenance, device="AMD EPYC", hardware=zen3)
    assert of.machine == f"{zen3}, 2 threads"
    assert of.machine != dataclasses.replace(of, hardware=zen5).machine
    assert of.machine != dataclasses.replace(of, hardware=dataclasses.replace(zen3, instruction_set="v2")).machine
    assert dataclasses.replace(of, device="A GPU").machine == f"A GPU in {zen3}, 2 threads"
    plain = make().provenance
    threads = [dataclasses.replace(plain, threads=n).machine for n in (1, 2)]
    assert threads == ["Invented CPU, 1 thread", "Invented CPU, 2 threads"]
    cpuinfo = EPYC.format(n=0, family=25)  # the system keeps some MB more or fewer at each boot
    assert system(cpuinfo, "24684092 kB") == system(cpuinfo, "24690001 kB") != system(cpuinfo, "32690001 kB")
    arm = "processor\t: 0\nCPU implementer\t: 0x41\nCPU part\t: 0xd0c\nCPU revision\t: 1\n"
    assert "family 0x41 model 0xd0c stepping 1, 2 cores" in str(system(arm))
    assert str(system("", "?")).endswith(", 2 cores")


def test_a_record_without_its_machine_is_read(tmp_path):
    """Would catch older records that can no longer be read, and a machine that is lost on the way to the disk."""
    path = tmp_path / "record.json"
    files.write(make(), path)
    plain = json.loads(path.read_text())
    del plain["provenance"]["hardware"]
    path.write_text(json.dumps(plain))
    assert files.read(path).provenance.machine == "Invented CPU, 2 threads"
