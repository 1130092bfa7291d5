"""Say what this process may use of its machine: threads, workers and memory. Only workers need torch."""
