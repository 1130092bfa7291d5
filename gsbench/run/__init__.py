"""Do one run: train a model on a scene, measure it and write its record. This module imports nothing heavy."""
