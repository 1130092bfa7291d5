"""gsbench: what a dimension of a Gaussian is worth, measured on one rasterizer, one trainer, one protocol."""

__version__ = "0.1.0"
