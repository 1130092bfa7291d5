"""Measure what a dimension of a Gaussian is worth, with one rasterizer, one trainer and one protocol for all models."""

import os

# Idle OpenMP threads sleep instead of spinning. Spinning threads of torch take the cores from those of the kernels, and
# both take them from other programs. An OpenMP runtime reads this variable once, when torch or the kernels load it.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

__version__ = "0.1.0"
