"""The authors' released networks in plain PyTorch, written anew: the opponents of `against_release.py`.

Every module has the release's name, so that a released state dict loads as it is (`layers.load_released`).
The same operations run in the same order; what no output depends on is left out, in the release's favour: the
classifier of HRNet, the embedding of the heat maps, the last feed-forward network and the hand's template,
which is given. Evaluation only.

Needs PyTorch and NumPy, nothing else: not this package.
"""
