"""Do many runs: expand what a command line asks for into one run for each combination."""
