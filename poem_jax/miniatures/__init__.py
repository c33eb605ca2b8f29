"""Tiny stand-ins of data sets: every file and field of the real ones, with our own hand in them."""
