"""Fine-tune a model on your own rig: a few hundred labelled frames of your cameras.

What:      the model that --init names (released and imported, shipped, your own) goes on at a low rate on the
           captures that --data names, three samples of four; the fourth is a synthetic capture, so that what
           it knew stays. The last fifth of every capture is never trained on: its errors are watched, and the
           checkpoint that is best there is kept. `--frozen-views` keeps trunk and heat maps as they are.
Data:      captures with labels, such as `poem fit` writes (docs/training.md, "Fine-tune on your own rig").
Hardware:  2 CPU cores for the shipped model; one GPU for the released ones.
Time:      not measured; 1,000 steps of 4 samples.
Expected:  the held-out error falls below that of the first validation; no number of ours yet.
Command:   poem train finetune
           --init CKPT --data DIR
Then:      poem train finetune --init CKPT --data DIR --export my_model
"""

from poem_jax.data.augmentation_recipes import PAPER
from poem_jax.experiments.parts.data_sets import on_captures
from poem_jax.experiments.synthetic_benchmark import benchmark
from poem_jax.models.presets import preset
from poem_jax.training.config import (
    BatchShape,
    DataConfig,
    OptimizerConfig,
    RunConfig,
    TrainConfig,
)
from poem_jax.training.recipes import recipe_of

_model = preset("tiny")
config = TrainConfig(
    name="finetune",
    model=_model,
    data=DataConfig(
        synthetic=benchmark,
        seed=5,
        batches=(BatchShape(num_views=4, batch_size=4),),
        mixture=on_captures("capture", PAPER, box_ratio=_model.crop.ratio),
    ),
    loss=recipe_of(_model).loss,
    training_root=recipe_of(_model).training_root,
    optimizer=OptimizerConfig(learning_rate=5e-5, warmup_steps=50, final_ratio=0.01, ema_decay=0.99),
    train=RunConfig(
        steps=1000,
        out="runs/finetune",
        init_from="shipped",
        log_every=20,
        checkpoint_every=100,
        keep_best=True,
        validate_every=100,
        validation_views=(4,),
        panel_every=500,
    ),
)
