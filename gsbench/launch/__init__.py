"""Launch runs: expand a command to its runs, do them here, in parallel or on Slurm, and show the state of each.

The state of a sweep follows from its results folder and from Slurm's queue; there is no daemon and no database.
"""
