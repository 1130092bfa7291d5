"""Choose the effects that a scene, and each of its Gaussians, calls for: time, direction, AGR, harmonics."""
