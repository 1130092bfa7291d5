"""Resolve everything that `make` installs, and write it with versions and hashes: ``make locks``.

uv resolves for every Python and platform at once and reads metadata alone. `constraints.txt` says the versions of what
gsbench names itself; what comes along is the newest. A line is installed without its own requirements, so each of them
is a line too; pip refuses a file with another hash.
"""

import re
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parent
BUILD = "cmake\nninja\nscikit-build-core\nnanobind\nsetuptools\n"  # gsbench's, and of the one package without a wheel
BLENDER = "bpy==4.5.12 ; python_version < '3.12'\npillow==13.0.0\n"  # it needs numpy 1.26, so it has a .venv of its own
CUDA = ("torch", "triton", "nvidia-", "cuda-")  # how the names begin that a torch for the CPU has or replaces
UV = ["-m", "uv", "pip", "compile", "--quiet", "--universal", "--generate-hashes", "--python-version", "3.11"]
PLAIN = ["--no-header", "--no-annotate", "--no-emit-index-url"]

Lock = dict[str, str]  # the lines of each requirement, by its first one


def resolve(sources: list[str], constraints: list[Path], extra: str = "") -> Lock:
    """Return what some requirements come to, under constraints; `extra` is a requirements file of its own."""
    words = [word for path in constraints for word in ("--constraint", str(path))]
    done = subprocess.run([sys.executable, *UV, *PLAIN, *words, *sources, "-"], cwd=ROOT, input=extra,
                          capture_output=True, text=True, check=False)  # fmt: skip
    if done.returncode:
        raise SystemExit(done.stderr)
    return {block.partition(" \\\n")[0]: block for block in re.split(r"\n(?=\S)", done.stdout.strip())}


def write(name: str, lock: Lock, what: str) -> None:
    """Write a lock with a line that says what it is for."""
    lines = "\n".join(lock[key] for key in sorted(lock))
    (FOLDER / name).write_text(f"# {what} Written by `make locks`.\n{lines}\n")


def main() -> None:
    """Write all locks but that of torch for the CPU."""
    pyproject = ["pyproject.toml", "--extra", "dev"]
    everything = resolve([*pyproject, "--extra", "docs"], [ROOT / "constraints.txt"], BUILD)
    pins = FOLDER / "pins.tmp"
    pins.write_text("\n".join(everything))
    try:
        build = resolve([], [pins], BUILD)
        tests = resolve(pyproject, [pins])
    finally:
        pins.unlink()
    cuda = {key: block for key, block in everything.items() if re.match(rf"({'|'.join(CUDA)})(?!vision)", key)}
    write("build.txt", build, "What builds gsbench, and the one package that has no wheel.")
    write("torch.txt", cuda, "torch as PyPI has it; on Linux with several GB of CUDA.")
    write("tests.txt", {key: tests[key] for key in tests.keys() - build.keys() - cuda.keys()},
          "What gsbench, its viewer and its tests need, less torch.")  # fmt: skip
    write("docs.txt", {key: everything[key] for key in everything.keys() - tests.keys() - build.keys() - cuda.keys()},
          "What the site and the notebooks need besides.")  # fmt: skip
    write("blender.txt", resolve([], [], BLENDER), "What `make scenes` renders the embedded scenes with.")
    write("uv.txt", resolve([], [], "uv\n"), "What `make locks` itself runs.")


if __name__ == "__main__":
    main()
