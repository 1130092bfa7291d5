"""Add and remove Gaussians during a training: the rules of 3DGS, 3DGS-MCMC and FastGS."""
