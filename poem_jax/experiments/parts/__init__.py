"""What several experiments are made of, and what tries them all."""
