"""gsbench: what a dimension of a Gaussian is worth, measured on one rasterizer, one trainer, one protocol."""

import os

# Threads of OpenMP that wait do so asleep; a runtime reads this once, as torch or the kernels load it. Awake, they take
# the cores from whoever they wait for: torch's threads from the kernels', another program's from both.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

__version__ = "0.1.0"
