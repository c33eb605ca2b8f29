"""State, pure step, loop, checkpoints."""
