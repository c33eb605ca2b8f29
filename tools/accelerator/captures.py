"""Batches of synthetic captures drawn by processes beside a GPU, which the threads of one could not feed.

They are those of `training.source.synthetic_batches`, sample for sample; the processes are a mixture's.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from poem_jax.batch import MultiViewBatch
from poem_jax.data.view_sampling import AllViews
from poem_jax.mixture.config import MixtureConfig, Part, SyntheticSource
from poem_jax.mixture.samples import open_mixture
from poem_jax.mixture.workers import Workers
from poem_jax.training.config import DataConfig
from poem_jax.training.source import BatchAt, synthetic_batches


@contextmanager
def drawn_by_processes(config: DataConfig, count: int) -> Iterator[BatchAt]:
    """Give the function from a step to its batch, drawn by `count` processes, which end here."""
    # A mixture of one part gives at position n its capture n, with as many views as are asked for.
    alone = MixtureConfig((Part(SyntheticSource(), views=AllViews()),), pose=True)
    mixture = open_mixture(
        alone, synthetic=config.synthetic, seed=config.seed, image_hw=config.synthetic.image_hw
    )
    with Workers(mixture, count) as workers:

        def draw(asked: Sequence[tuple[int, int]]) -> list[MultiViewBatch]:
            waiting = [workers.submit(index, views) for index, views in asked]
            return [future.result().sample for future in waiting]

        yield synthetic_batches(config, draw=draw)
