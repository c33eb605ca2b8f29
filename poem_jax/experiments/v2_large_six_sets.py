"""POEM v2-large (width 512) as the paper trains it, on six data sets.

What:      as v2_base_six_sets, with another model.
Data:      as there.
Hardware:  the paper's: 4 NVIDIA A6000.
Time:      the paper's: 152 hours there; not measured here.
Expected:  the paper's MPVPE, table of the generalizable model: DexYCB 6.50, OakInk 8.33, HO3D 7.63, InterHand
           7.64, ARCTIC 5.89 mm with all cameras. No number of ours yet.
Command:   poem train v2_large_six_sets
"""

from poem_jax.experiments.parts.six_sets import on_six_sets

config = on_six_sets("v2_large_six_sets", "v2-large")
configs = {"raw": on_six_sets("v2_large_six_sets_raw", "v2-large", raw=True)}
