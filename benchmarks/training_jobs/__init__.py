"""What `benchmarks/training.py` measures, each job in a process of its own."""
