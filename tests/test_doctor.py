"""The doctor: every line says what is there, and what to do where something is not."""

import json
import runpy
import shutil
from importlib import metadata
from types import SimpleNamespace

import pytest
import torch
from tiny_run import main_here

from gsbench import doctor, kernels
from gsbench.doctor import ABSENT, BROKEN, OK, Check
from gsbench.kernels import cuda
from gsbench.measure import perceptual
from gsbench.process import memory


def checks(capsys, status: int = 0) -> dict[str, Check]:
    """The checks that `python -m gsbench doctor --json` prints, by name."""
    assert main_here("doctor", "--json") == status
    return {listed["name"]: Check(**listed) for listed in json.loads(capsys.readouterr().out)["checks"]}


def test_one_screen_names_every_part(capsys, monkeypatch):
    """Catches a part that is not looked at, a screen that scrolls, and a part that is absent without advice."""
    # What is free changes between the two calls of the doctor.
    monkeypatch.setattr(memory, "available", lambda: 3 << 30)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=5 << 30))
    assert main_here("doctor") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 20
    listed = checks(capsys)
    assert lines == [check.line for check in listed.values()]
    names = {"gsbench", "python", "packages", "extras", "processor", "threads", "memory", "disk", "compiler", "kernels"}
    assert listed.keys() == names | {"gpu", "lpips alex", "lpips vgg", "data"}
    assert torch.__version__ in listed["packages"].detail
    assert listed["memory"].detail.startswith("3.0 of")
    assert all(check.todo for check in listed.values() if check.state == ABSENT and check.name != "gpu")


def test_it_is_a_module_as_the_other_commands_are(capsys, monkeypatch):
    """Catches `python -m gsbench.doctor`, which looks like them, ending well without a word."""
    monkeypatch.setattr("sys.argv", ["doctor", "--json"])
    with pytest.raises(SystemExit):
        runpy.run_path(doctor.__file__, run_name="__main__")
    assert json.loads(capsys.readouterr().out)["checks"]


@pytest.mark.parametrize(
    ("part", "patched", "attribute", "value"),
    [
        ("kernels", kernels, "_native", None),
        ("kernels", doctor, "_difference", lambda: 0.5),  # a build for another machine may load and compute nonsense
        ("disk", doctor, "LEAST_DISK", 1 << 60),
        ("threads", torch, "get_num_threads", lambda: 4096),
        ("gpu", shutil, "which", lambda name: f"/usr/bin/{name}"),  # nvidia-smi: a driver, but a torch without CUDA
    ],
)
def test_a_part_that_is_broken_is_status_1_with_advice(part, patched, attribute, value, capsys, monkeypatch):
    """Catches an exit status of 0 for an installation that renders by the slow reference, or cannot write."""
    monkeypatch.setattr(doctor, "LEAST_DISK", 0)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    monkeypatch.setattr(patched, attribute, value)
    listed = checks(capsys, status=1)
    assert {check.name for check in listed.values() if check.state == BROKEN} == {part}
    assert listed[part].todo


def test_the_compiler_is_the_one_that_builds(capsys, monkeypatch, tmp_path):
    """Catches the first compiler of a list in place of the one that CXX names, with which a build from source runs."""
    compiler = tmp_path / "my-c++"
    compiler.write_text("#!/bin/sh\necho my compiler 1.0\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CXX", f"{compiler} -m64")  # as "ccache g++"
    assert checks(capsys)["compiler"].detail == "my compiler 1.0"
    monkeypatch.setenv("CXX", "/no/such")
    assert checks(capsys)["compiler"].detail == "none: CXX=/no/such is not there"


def test_kernels_are_checked_on_an_image_that_is_not_empty():
    """Catches Gaussians outside of the image, on which all backends agree."""
    assert 0 < doctor._difference() < 1e-5


def test_missing_packages_and_an_unforeseen_error_are_lines(capsys, monkeypatch):
    """Catches a stack trace, and checks that end at the first of them that fails."""

    def version(package: str) -> str:
        if package in ("scipy", "viser"):
            raise metadata.PackageNotFoundError(package)
        return "1.0"

    def crash() -> None:
        raise OSError("the disk\nis gone")

    monkeypatch.setattr(metadata, "version", version)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: crash())
    listed = checks(capsys, status=1)
    assert listed["packages"].detail == "missing: scipy"
    assert "view" in listed["extras"].todo
    assert "view" not in listed["extras"].detail
    assert (listed["disk"].state, listed["disk"].detail) == (BROKEN, "OSError: the disk")
    assert listed["data"].state == OK


@pytest.mark.parametrize("built", [True, False])
def test_a_gpu_is_named_with_its_kernels(built, capsys, monkeypatch):
    """Catches a GPU that renders by the slow reference without a word."""
    device = type("Device", (), {"name": "Invented GPU", "total_memory": 80 << 30})
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_properties", [device].__getitem__)
    monkeypatch.setattr(cuda, "_cuda", torch if built else None)
    listed = checks(capsys, status=0 if built else 1)["gpu"]
    assert "Invented GPU, 80 GiB" in listed.detail
    assert (listed.state == OK) == built == (not listed.todo)


def test_what_is_absent_breaks_nothing(capsys, monkeypatch):
    """Catches a machine without a GPU or a compiler that is called broken, and advice on a GPU that is not there."""
    monkeypatch.setattr(shutil, "which", lambda _: None)
    listed = checks(capsys)
    assert (listed["gpu"], listed["compiler"].state) == (Check("gpu", ABSENT, "none; the CPU trains", ""), ABSENT)


def test_the_commit_is_named_and_data_that_are_here(capsys, monkeypatch, tmp_path):
    """Catches a wheel taken for a checkout, and advice to fetch what is there."""
    (tmp_path / "data" / "dnerf").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    for commit, words in ((f"{'a' * 40}-dirty", ", commit aaaaaaaaaaaa-dirty, in "), (None, ", from a wheel, in ")):
        monkeypatch.setattr(doctor, "git_commit", lambda commit=commit: commit)
        listed = checks(capsys)
        assert words in listed["gsbench"].detail
    assert listed["data"].detail == "the embedded scenes, data/dnerf"
    assert listed["data"].todo == "for more: python -m gsbench.fetch pbr"


def test_weights_that_are_here_need_no_advice(capsys, monkeypatch):
    """Catches advice to fetch what is there."""
    monkeypatch.setattr(perceptual, "is_here", lambda backbone: backbone == "alex")
    listed = checks(capsys)
    assert (listed["lpips alex"].state, listed["lpips alex"].todo) == (OK, "")
    assert listed["lpips vgg"].todo == "python -m gsbench.fetch lpips-vgg"
