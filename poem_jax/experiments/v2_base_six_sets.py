"""POEM v2-base as the paper trains it: six data sets mixed, at 256 x 256.

What:      HRNet-W40 trunk, width 256, three layers; 0.18 of the samples from each of DexYCB, HO3D, OakInk,
           ARCTIC and InterHand2.6M, 0.10 from FreiHAND; 1 to all views in random order; the paper's
           augmentation; losses on every layer; Adam 1e-4 with a cosine decay; batch 32, 65,625 steps. These
           are 2.1 million samples, ten epochs of 210,000; the paper's "2,100,000 iterations" at batch 32 is
           the other reading: `--train.steps 2100000`. Batch 16: `--data.batches.0.batch-size 16 --train.steps
           131250`. The trunk starts from ImageNet in the paper: `--train.first-stage-from DIR` with a file
           that you bring (docs/weights.md).
Data:      the authors' tars in data/dataset_tars/, or with `v2_base_six_sets:raw` the raw sets in data/raw/
           and MANO (poem_jax/experiments/parts/data_sets.py).
Hardware:  the paper's: 4 NVIDIA A6000; every device takes an equal part of the batch.
Time:      the paper's: 116 hours there; not measured here.
Expected:  the paper's MPVPE, table of the generalizable model: DexYCB 6.80, OakInk 8.55, HO3D 8.12, InterHand
           9.45, ARCTIC 6.78 mm with all cameras. No number of ours yet.
Command:   poem train v2_base_six_sets
"""

from poem_jax.experiments.parts.six_sets import on_six_sets

config = on_six_sets("v2_base_six_sets", "v2-base")
configs = {"raw": on_six_sets("v2_base_six_sets_raw", "v2-base", raw=True)}
