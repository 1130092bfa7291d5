"""`make gpu-check` on the machine it is written for: it has torch and what builds, not all that gsbench needs."""

from pathlib import Path

from forked import python

ROOT = Path(__file__).resolve().parents[2]
WITHOUT_MOST = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("cv2", "hydra", "lpips", "omegaconf", "pandas", "skimage"):
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Missing())
"""


def test_nothing_it_runs_needs_the_rest_of_gsbench():
    """Catches an import by which a GPU machine's tests and benchmarks all fail, where none can be had to see it."""
    collect = ["-p", "no:hydra_pytest", "-p", "no:cacheprovider", "-q", "--collect-only"]
    collect += ["tests/kernels", "tests/raster"]
    code = f"{WITHOUT_MOST}\nimport benchmarks.gpu, benchmarks.gpu_small, pytest\nsys.exit(pytest.main({collect}))"
    done = python("-c", code, cwd=ROOT)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
