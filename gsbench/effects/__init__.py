"""Choose the effects that a scene and each of its Gaussians need: time, direction, AGR, harmonics."""
