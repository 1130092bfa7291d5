"""Add and remove Gaussians by the rules of 3DGS (gradient.py), 3DGS-MCMC (mcmc.py) and FastGS (multiview.py).

control.py calls the rule of a training when gsbench/schedule.py says so.
"""
