"""Choose whether a scene needs time, and which Gaussians need time, direction, AGR (neural refinement) or SH."""
