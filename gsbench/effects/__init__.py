"""Choose whether a scene needs time, and which Gaussians need time, view direction, AGR and higher SH degrees."""
