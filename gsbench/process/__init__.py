"""Configure the threads, parallel workers and memory of this process. Only `workers` imports torch."""
