"""Train a few steps by the command line of an installed gsbench, in an empty folder: python tests/smoke.py [reference].

Tells whether a wheel is whole: the compiled kernels, the configs, the embedded scenes, the command. With `reference` it
expects an installation without kernels, which says so. No test of pytest: it is run by the Python to which gsbench was
installed, and needs nothing beside.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]
WHERE = "import gsbench; from gsbench import kernels; print(gsbench.__file__, kernels.available(), sep='|')"
SLOW = "gsbench: warning: raster backend 'auto': the native kernels are not built"
STEPS = 20
PYTHON = [sys.executable, *["-S"] * sys.flags.no_site]  # as this process was started


def main() -> None:
    """Check the installation, train, and read the record; exit with a line that says what is wrong."""
    expected = "reference" if sys.argv[1:] == ["reference"] else "cpu"
    with tempfile.TemporaryDirectory() as folder:
        file, built = run(folder, "-c", WHERE).stdout.strip().split("|")
        if Path(file).is_relative_to(CHECKOUT):
            sys.exit(f"smoke: expected an installed gsbench, found the checkout's: {file}")
        if (built == "True") != (expected == "cpu"):
            sys.exit(f"smoke: expected kernels for {expected}, {'found them' if built == 'True' else 'found none'}")
        words = ["+exp=mini", "model=3dgs", "scene=suzanne", "scene.downscale=4", "data.initial_points=500"]
        words += [f"train.iterations={STEPS}", "train.curve_points=1", "results=results"]
        done = run(folder, "-m", "gsbench", *words)
        if sum(line.startswith(SLOW) for line in done.stderr.splitlines()) != (expected == "reference"):
            sys.exit(
                f"smoke: expected {'one line' if expected == 'reference' else 'no line'} that there are no "
                f"kernels: {done.stderr}"
            )
        (path,) = Path(folder).glob("results/mini/suzanne/*/seed0/record.json")
        psnr = json.loads(path.read_text())["metrics"]["psnr"]
        print(f"smoke: {STEPS} steps by {expected}: {psnr:.2f} dB on test, by {file}")


def run(folder: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run this Python in a folder; exit with what it said if it fails."""
    done = subprocess.run([*PYTHON, *arguments], cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"smoke: python {' '.join(arguments)} exits {done.returncode}: {done.stderr or done.stdout}")
    return done


if __name__ == "__main__":
    main()
