"""Do many runs: plan a grid, see what became of each of its runs, put back those that did not end.

The state of a sweep is what lies in its results folder and what Slurm says; there is no daemon and no database.
No module here imports torch, so that the status of a sweep is there at once.
"""
