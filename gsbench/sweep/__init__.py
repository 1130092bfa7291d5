"""Do many runs: plan a grid of runs, show the state of each run, and launch again the runs that did not finish.

The state of a sweep is its results folder and Slurm's queue; there is no daemon and no database. No module here
imports torch, so the status of a sweep is shown without delay.
"""
