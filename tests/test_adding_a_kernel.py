"""The worked example of docs/adding_a_kernel.md, built and run as a reader would."""

import os
import re
import shutil
import sys
from pathlib import Path

import pytest
from forked import ended, python
from tiny_run import ROOT, environment

from benchmarks.against import WITHOUT_EDITABLE
from gsbench import kernels

PAGE = (ROOT / "docs/adding_a_kernel.md").read_text()
# Sources of the CPU that are compiled; the other kernels take most of a minute.
KEPT = ("bindings.cpp", "dispatch.cpp", "table.cpp", "roofline.cpp", "ball.cpp")
CHECK = (
    f"{WITHOUT_EDITABLE}\n"
    + """
import torch
from gsbench.kernels.balls import slice_ball
from gsbench.kernels.tape import Tape
g = torch.Generator().manual_seed(0)
raw = [torch.randn(shape, generator=g).requires_grad_() for shape in ((37, 1), (37,))]
weights = torch.randn(37, 3, 3, generator=g), torch.randn(37, generator=g)
exact = [x.detach().double().requires_grad_() for x in raw]
expected = exact[0].exp()[:, :, None] * torch.eye(3, dtype=torch.float64), torch.sigmoid(exact[1])
for got, wanted in zip(slice_ball(*raw), expected, strict=True):
    torch.testing.assert_close(got.double(), wanted, rtol=1e-5, atol=1e-6)
def loss(balls): return sum((x * w).sum() for x, w in zip(balls, weights, strict=True))
want = torch.autograd.grad(loss(expected), exact)
got = torch.autograd.grad(loss(slice_ball(*raw)), raw)
with Tape() as tape: value = loss(slice_ball(*raw))
sums = {}
tape.backward(value, torch.ones(()), raw, sums)
for x, a, b in zip(raw, got, want, strict=True):
    torch.testing.assert_close(a.double(), b, rtol=1e-4, atol=1e-6)
    assert torch.equal(sums[id(x)], a)
"""
)


def insertions() -> list[tuple[str, str, str]]:
    """What the page inserts into files: path, the line that the text goes before, the text."""
    listings = r"^`(gsbench/[\w/]+\.\w+)`, before `(.*?)`:\n\n```\w+\n(.*?)^```"
    return re.findall(listings, PAGE, flags=re.MULTILINE | re.DOTALL)


def files() -> list[tuple[Path, str]]:
    """The example's files, and the folder into which the page puts each."""
    rows = re.findall(r"\]\(\.\./(examples/kernel/[\w.]+)\) \| `(gsbench/kernels/\w*/?)`", PAGE)
    return [(ROOT / file, folder) for file, folder in rows]


def test_it_touches_fewer_than_eight_files():
    """Catches seams that cost more again: a kernel for a new slice once touched 22 files."""
    assert sorted(path for path, _ in files()) == sorted((ROOT / "examples/kernel").iterdir())
    assert len(files()) + len({path for path, _, _ in insertions()}) == 5


@pytest.mark.skipif(not all(map(shutil.which, ("cmake", "ninja", "c++"))), reason="needs cmake, ninja and a compiler")
def test_the_worked_example_builds_and_differentiates(tmp_path):
    """Catches documentation that no longer builds, on the CPU and by the shim for CUDA, or a wrong gradient of it. The
    copy's other kernels are empty."""
    project, build = tmp_path / "project", tmp_path / "build"
    left_out = shutil.ignore_patterns("__pycache__", "sample", "*.so")
    shutil.copytree(ROOT / "gsbench", project / "gsbench", ignore=left_out)
    (project / "gsbench/scenes/sample").mkdir()
    shutil.copy(ROOT / "CMakeLists.txt", project)
    (project / "tests/kernels").mkdir(parents=True)
    for path in (ROOT / "tests/kernels").glob("cuda_shim.*"):
        shutil.copy(path, project / "tests/kernels")
    for path, folder in files():
        assert not (project / folder / path.name).exists()
        shutil.copy(path, project / folder)
    for name, before, text in insertions():
        target = project / name
        whole = target.read_text()
        assert whole.count(before) == 1
        target.write_text(whole.replace(before, text + before))
    for path in (project / "gsbench/kernels").rglob("*.h"):
        path.write_text(re.sub(r"^    kernel\((?!slice_ball).*\n", "", path.read_text(), flags=re.MULTILINE))
    for path in (project / "gsbench/kernels/cpu").glob("*.cpp"):
        if path.name not in KEPT:
            path.write_text("")
    # Unoptimised, and for one instruction set, the widest: what is tested is that it compiles and is right.
    options = ["-G", "Ninja", "-DCUDA=shim", "-DCMAKE_BUILD_TYPE=Debug", "-DCMAKE_CXX_FLAGS_DEBUG=-O0 -DNDEBUG"]
    options += ["-DGSB_OPTIMISATION=-O0", f"-DGSB_LEVELS={kernels.instruction_set() or 'native'}"]
    options.append(f"-DPython_EXECUTABLE={sys.executable}")
    shim = [f"CMakeFiles/_cuda.dir/gsbench/kernels/cuda/{name}.o" for name in ("ball.cu", "bindings.cpp")]
    for command in (
        ["cmake", "-S", str(project), "-B", str(build), *options],
        ["cmake", "--build", str(build), "--target", "_native", *shim],
    ):
        done = ended(*command)
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    shutil.copy(next(build.glob("_native*.so")), project / "gsbench/kernels")
    done = python("-c", CHECK, cwd=project, env=environment() | {"PYTHONPATH": os.fspath(project)})
    assert done.returncode == 0, done.stderr
