"""POEM v2-param (its last layer regresses pose and shape) as the paper trains it, on six raw data sets.

What:      as v2_base_six_sets, with another model.
Data:      the raw sets in data/raw/ and MANO_RIGHT.pkl (poem_jax/experiments/parts/data_sets.py): OakInk's
           tars have no poses.
Hardware:  the paper's: 4 NVIDIA A6000.
Time:      the paper does not say; not measured here.
Expected:  the paper's MPVPE, table of the generalizable model: DexYCB 7.00, OakInk 7.91, HO3D 9.16 mm with
           all cameras. No number of ours yet.
Command:   poem train v2_param_six_sets
"""

from poem_jax.experiments.parts.six_sets import on_six_sets

config = on_six_sets("v2_param_six_sets", "v2-param", raw=True)
