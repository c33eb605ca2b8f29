"""Sources mixed: which sample a step sees, read and augmented in worker processes."""
