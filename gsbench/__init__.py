"""Compare 3D, 4D, 6D and 7D Gaussian splatting with one rasterizer, one trainer and one protocol for all models."""

import importlib
from typing import TYPE_CHECKING, Any

from gsbench.process.start import compute_the_same_bits, keep_freed_memory, sleep_when_idle
from gsbench.version import __version__ as __version__

keep_freed_memory()  # these three calls must come before the import of torch or the kernels
sleep_when_idle()
compute_the_same_bits()

__all__ = ["CameraTime", "build", "load_run", "load_scene", "lpips", "psnr", "rasterize", "slice_gaussians", "ssim"]

_PUBLIC = {  # the names of __all__ with the modules that define them
    "CameraTime": "gsbench.models.camera_time.CameraTime",
    "build": "gsbench.models.registry.build",
    "load_run": "gsbench.run.load.load_run",
    "load_scene": "gsbench.scenes.load",
    "lpips": "gsbench.measure.quality.lpips",
    "psnr": "gsbench.measure.quality.psnr",
    "rasterize": "gsbench.raster.rasterize",
    "slice_gaussians": "gsbench.models.slicing.slice_gaussians",
    "ssim": "gsbench.measure.quality.ssim",
}

if TYPE_CHECKING:  # type checkers and editors do not run the code below, so they get imports
    from gsbench.measure.quality import lpips, psnr, ssim
    from gsbench.models.camera_time import CameraTime
    from gsbench.models.registry import build
    from gsbench.models.slicing import slice_gaussians
    from gsbench.raster import rasterize
    from gsbench.run.load import load_run
    from gsbench.scenes import load as load_scene
else:

    def __getattr__(name: str) -> Any:
        """Import a public name of gsbench when it is first used, so that `import gsbench` does not import torch."""
        if name not in _PUBLIC:
            raise AttributeError(f"module 'gsbench' has no attribute '{name}'")
        module, _, attribute = _PUBLIC[name].rpartition(".")
        return getattr(importlib.import_module(module), attribute)

    def __dir__() -> list[str]:
        """List all names of the package for completion, including public names that are not imported yet."""
        return sorted({*globals(), *__all__})
