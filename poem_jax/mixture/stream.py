"""A mixture at work: workers that draw its samples and the report of what could not be used."""

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from poem_jax.batch import MultiViewBatch
from poem_jax.mixture.report import DataReport
from poem_jax.mixture.samples import Mixture
from poem_jax.mixture.workers import Workers

REPORT = "data_report.json"


class MixtureStream:
    """Draws samples by their positions, in processes or here; use it as a context manager.

    Safe to share between threads: a loader draws several batches at a time.
    """

    def __init__(self, mixture: Mixture, *, processes: int, run_dir: Path, max_corrupt_share: float) -> None:
        """Start the workers and the sitting's report.

        Args:
            mixture: what is drawn.
            processes: worker processes; 0 = whoever asks draws.
            run_dir: where `data_report.json` goes.
            max_corrupt_share: see `MixtureConfig`.
        """
        self._mixture = mixture
        self.report = DataReport(run_dir / REPORT, mixture.names, max_corrupt_share)
        for part, samples in enumerate(mixture.parts):
            self.report.note_left_out(part, samples.left_out())
        self._workers = Workers(mixture, processes) if processes else None

    def __enter__(self) -> "MixtureStream":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def samples(self, positions: Sequence[int], most_views: int) -> list[MultiViewBatch]:
        """Return the samples at these positions, with at most `most_views` views each.

        Raises:
            TooManyCorruptSamples: more than the config allows, so far.
            WorkerDied: a worker process ended.
            ValueError: fifty corrupt frames in a row.
        """
        if self._workers is None:
            drawn = [self._mixture.draw(position, most_views) for position in positions]
        else:
            waiting = [self._workers.submit(position, most_views) for position in positions]
            drawn = [future.result() for future in waiting]
        self.report.note(drawn)
        return [one.sample for one in drawn]

    def close(self) -> None:
        """End the workers and write the report."""
        try:
            if self._workers is not None:
                self._workers.close()
        finally:
            self.report.write()


def host_rows(step: int, size: int, stride: int, *, host: int = 0, hosts: int = 1) -> list[int]:
    """Return the positions of a step's samples in the mixture's stream that this host draws.

    Host h of H has the h-th of H equal blocks; one behind the other they are the batch of a single host.

    Args:
        step: the step.
        size: samples of this step on all hosts.
        stride: positions a step has for itself: the largest batch.
        host, hosts: this one, of how many.

    Raises:
        ValueError: a size that `hosts` does not divide: hosts would have parts of unequal size.
    """
    if size % hosts or not 0 <= host < hosts or size > stride:
        raise ValueError(
            f"a batch of {size} samples (the largest: {stride}) cannot be shared evenly; `host` {host} must "
            f"be one of {hosts} that divide it"
        )
    first = step * stride + host * (size // hosts)
    return list(range(first, first + size // hosts))
