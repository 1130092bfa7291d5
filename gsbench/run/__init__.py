"""Do one run: train a model on a scene, measure it and write its record.

The function for it is `gsbench.run.run.run`. It is not exported here, where its name is that of its module.
"""

from gsbench.run.identity import Run, identify
from gsbench.run.run import build, load_scene, summary

__all__ = ["Run", "build", "identify", "load_scene", "summary"]
