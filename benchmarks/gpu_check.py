"""Everything that needs a GPU, in one command of under eight minutes: python benchmarks/gpu_check.py --out FOLDER.

Builds for the GPU at hand, offline, as a user would (pip install --no-build-isolation --no-deps); runs the tests of the
backend and compute-sanitizer on it, all at once, then a short training, then the benchmarks beside gsplat, alone. A
part that fails or runs out of its time does not stop the next ones; the exit code is 1 if any did. The folder gets
gpu_check.{log,json,md} and gpu.{json,md}. Needs the interpreter's own torch for CUDA, nvcc, cmake, ninja, nanobind,
scikit-build-core, pytest, hypothesis; what else is missing (hydra, gsplat) is said and left out. Uses the standard
library only.
"""

import argparse
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TextIO

ROOT = Path(__file__).resolve().parents[1]
KERNELS = ROOT / "gsbench/kernels"
BUILD = ROOT / "build/gpu"
LIMIT = 470  # seconds for all parts
# The tools of this interpreter's environment first; those of CUDA where its installer puts them last.
PATH = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath), "/usr/local/cuda/bin"])
PROBE = "import torch; print('%d%d' % torch.cuda.get_device_capability(), torch.cuda.get_device_name(), sep='|')"
IMPORTED = "from gsbench.kernels import cuda; assert cuda.available(); print(cuda.cuda().__file__)"
# What the caller's own PYTHONPATH has (gsplat, hydra) stays importable.
SOURCES = os.pathsep.join([str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]).rstrip(os.pathsep)
# The tests that use a GPU if there is one.
TESTS = [
    str(path)
    for folder in ("kernels", "raster")
    for path in sorted((ROOT / "tests" / folder).glob("test_*.py"))
    if re.search('cuda_device|"cuda"', path.read_text())
]
# torch's caching allocator would hide a buffer that is run over from memcheck.
SANITIZER = [
    "env",
    "PYTORCH_NO_CUDA_MEMORY_CACHING=1",
    "compute-sanitizer",
    "--report-api-errors",
    "no",
    "--error-exitcode",
    "3",
]


class Check:
    """Runs parts one after the other and keeps how each one ended."""

    def __init__(self, out: Path, log: TextIO) -> None:
        self.out = out
        self.log = log
        self.end = time.monotonic() + LIMIT
        self.parts: list[dict[str, str | float]] = []

    def run(self, name: str, command: list[str], seconds: float, **environment: str) -> bool:
        """Run one part from the repository's root; returns whether it ended well, within its time."""
        return self.run_at_once({name: command}, seconds, **environment)

    def run_at_once(self, commands: dict[str, list[str]], seconds: float, **environment: str) -> bool:
        """Run parts that are not timed at once; returns whether all ended well, within the time that each has."""
        seconds = min(seconds, self.end - time.monotonic())
        if seconds <= 0:
            for name in commands:
                self.note(name, "failed: no time was left for it")
            return False
        with ThreadPoolExecutor(len(commands)) as pool:
            return all(list(pool.map(lambda part: self._part(*part, seconds, environment), commands.items())))

    def _part(self, name: str, command: list[str], seconds: float, environment: dict[str, str]) -> bool:
        self.say(f"== {name}: {' '.join(command)}")
        began = time.monotonic()
        env = {**os.environ, "PYTHONPATH": SOURCES, "PYTHONUNBUFFERED": "1", "PATH": PATH, **environment}
        with tempfile.TemporaryFile("w+") as output:
            try:
                process = subprocess.Popen(
                    command, cwd=ROOT, env=env, stdout=output, stderr=output, start_new_session=True
                )
                code = process.wait(seconds)
                outcome = f"failed: exit code {code}" if code else "ok"
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)  # compilers and debuggers have children of their own
                process.wait()
                outcome = f"failed: not done after {seconds:.0f} s"
            except OSError as error:
                outcome = f"failed: {error.strerror}: {error.filename}"
            output.seek(0)
            self.log.write(f"== {name} said:\n{output.read()}")
        return self.note(name, outcome, time.monotonic() - began)

    def note(self, name: str, outcome: str, seconds: float = 0.0) -> bool:
        """Keep how a part ended, on disk as well: what is known if time runs out."""
        self.parts.append({"part": name, "outcome": outcome, "seconds": round(seconds, 1)})
        self.say(f"== {name}: {outcome} ({seconds:.0f} s)")
        lines = ["# gpu-check", "", "| part | outcome | seconds |", "| --- | --- | ---: |"]
        lines += [f"| {part['part']} | {part['outcome']} | {part['seconds']} |" for part in self.parts]
        lines += ["", "What each part said: gpu_check.log. Figures: gpu.md.", ""]
        (self.out / "gpu_check.md").write_text("\n".join(lines))
        (self.out / "gpu_check.json").write_text(json.dumps({"parts": self.parts}, indent=1))
        return outcome == "ok"

    def say(self, line: str) -> None:
        for stream in (self.log, sys.stdout):
            print(line, file=stream, flush=True)

    @property
    def failed(self) -> bool:
        return any(str(part["outcome"]).startswith("failed") for part in self.parts)


def main() -> None:
    parser = argparse.ArgumentParser(prog="benchmarks/gpu_check.py", description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "results/benchmarks", help="folder of the results")
    out = parser.parse_args().out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    probe = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True)
    with (out / "gpu_check.log").open("w") as log:
        check = Check(out, log)
        if probe.returncode != 0:
            last = (probe.stderr.strip().splitlines() or ["no reason given"])[-1]
            check.note("GPU", f"failed: torch of {sys.executable} finds no CUDA device ({last})")
        else:
            capability, name = probe.stdout.strip().split("|")
            check.note("GPU", "ok")
            check.say(f"{name}, sm_{capability}, Python {sys.version.split()[0]}")
            everything(check, capability)
    sys.exit(check.failed)


def everything(check: Check, capability: str) -> None:
    """All parts; those that need the kernels only if these were built."""
    python = sys.executable
    if not build(check, capability):
        return
    tests = [python, "-m", "pytest", "-p", "no:cacheprovider", *TESTS]
    if importlib.util.find_spec("xdist") is not None:
        tests += ["-n", str(min(8, os.cpu_count() or 1))]
    sanitized = {
        f"compute-sanitizer {tool}": [*SANITIZER, "--tool", tool, python, "-m", "benchmarks.gpu_small"]
        for tool in ("memcheck", "racecheck")
    }
    check.run_at_once({"tests": tests} | sanitized, 150)
    if importlib.util.find_spec("hydra") is None:
        check.note("training", "left out: hydra is not installed")
    else:
        with tempfile.TemporaryDirectory() as results:
            overrides = ["+exp=mini", "model=7dgs", "scene=moving-matte", "device=cuda", "train.iterations=300"]
            check.run("training", [python, "-m", "gsbench", *overrides, f"results={results}"], 90)
    if importlib.util.find_spec("gsplat") is None:
        check.note("gsplat", "left out: gsplat is not installed, so its columns stay empty")
    check.run("benchmarks", [python, "-m", "benchmarks.gpu", "--out", str(check.out)], 240)


def build(check: Check, capability: str) -> bool:
    """Install into a folder of its own, and put the extensions beside the sources, where the other parts find them."""
    shutil.rmtree(BUILD, ignore_errors=True)
    pip = [sys.executable, "-m", "pip", "install", "--no-build-isolation", "--no-deps", "--no-index"]
    built = check.run(
        "pip install",
        [
            *pip,
            "-C",
            "cmake.define.CUDA=on",
            "-C",
            f"build-dir={BUILD / 'cmake'}",
            "--target",
            str(BUILD / "site"),
            ".",
        ],
        240,
        CUDAARCHS=capability,
        CMAKE_BUILD_PARALLEL_LEVEL=str(os.cpu_count()),
    )
    for extension in (BUILD / "site/gsbench/kernels").glob("_*.so") if built else ():
        shutil.copy(extension, KERNELS / extension.name)
    return built and check.run("import", [sys.executable, "-c", IMPORTED], 60)


if __name__ == "__main__":
    main()
