"""Choose what a scene and each Gaussian depend on: time, direction of view, AGR and colour harmonics."""
