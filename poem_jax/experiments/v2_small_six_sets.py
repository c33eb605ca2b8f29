"""POEM v2-small (width 128) as the paper trains it, on six data sets.

What:      as v2_base_six_sets, with another model.
Data:      as there.
Hardware:  the paper's: 4 NVIDIA A6000.
Time:      the paper's: 102 hours there; not measured here.
Expected:  the paper's MPVPE, table of the generalizable model: DexYCB 7.48, OakInk 9.08, HO3D 8.53, InterHand
           9.69, ARCTIC 7.09 mm with all cameras. No number of ours yet.
Command:   poem train v2_small_six_sets
"""

from poem_jax.experiments.parts.six_sets import on_six_sets

config = on_six_sets("v2_small_six_sets", "v2-small")
configs = {"raw": on_six_sets("v2_small_six_sets_raw", "v2-small", raw=True)}
