"""Run many trainings: plan a grid of runs, show the state of each run, and launch unfinished runs again.

The state of a sweep follows from its results folder and from Slurm's queue; there is no daemon and no database. The
modules of this package load without torch, so the state of a sweep is shown without delay.
"""
