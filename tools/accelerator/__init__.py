"""What a GPU is worth here, in ten minutes: `make accelerator MINUTES=10`, or `python -m tools.accelerator`.

The rows of `plan.py` are measured in the order of their value, each in time or not at all, and each is on
disk before the next one begins; then the shipped model is trained on for what is left. `__main__.py` keeps
the time, `measurer.py` is its end of the pipe to the process that measures (`worker.py`), so that a row that
dies takes nothing along; `going_on.py` trains, with the captures of `captures.py`; `parts.py` packs what is
to be carried away, `readme.py` writes the figures into README.md.
"""
