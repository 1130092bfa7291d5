"""Configure the threads, workers and memory that this process uses. Only `workers` needs torch."""
