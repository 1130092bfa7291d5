"""Add, remove and move Gaussians by the rules of 3DGS, 3DGS-MCMC, FastGS and FreeTimeGS.

They are in gradient.py, mcmc.py, multiview.py and relocation.py. control.py calls the rule of a training when
gsbench/schedule.py says so.
"""
