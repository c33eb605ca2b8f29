"""Names of the trunks in PyTorch checkpoints: HRNet's own, and torchvision's for ResNets."""

from collections.abc import Iterator

from poem_jax.models.config import FrozenNorms, HRNetConfig, ResNetConfig, Stem
from poem_jax.weights.name_table import NameRows, conv_norm

_BASIC = ((1, "first"), (2, "second"))
_BOTTLENECK = ((1, "reduce"), (2, "middle"), (3, "expand"))


def trunk_rows(config: HRNetConfig | ResNetConfig, prefix: str = "") -> NameRows:
    """List every array of a trunk.

    Raises:
        ValueError: a trunk that has no counterpart in PyTorch.
    """
    return hrnet_rows(config, prefix) if isinstance(config, HRNetConfig) else resnet_rows(config, prefix)


def hrnet_rows(config: HRNetConfig, prefix: str = "") -> NameRows:
    """List an HRNet: `conv1`, `layer1.0.conv1`, `stage2.0.branches.0.0.conv1`, ... after `prefix`."""
    for i in (1, 2):
        yield from conv_norm(f"{prefix}conv{i}", f"{prefix}bn{i}", f"trunk.stem.{i - 1}")
    yield from _block(f"{prefix}layer1.0", "trunk.widen", _BOTTLENECK)
    yield from conv_norm(
        f"{prefix}layer1.0.downsample.0", f"{prefix}layer1.0.downsample.1", "trunk.widen.shortcut"
    )
    for i in range(1, config.stem_blocks):
        yield from _block(f"{prefix}layer1.{i}", "trunk.layer1.blocks", _BOTTLENECK, (i - 1,))
    starts = {"transition1.0": "transition1.0", "transition1.1.0": "transition1.1"}
    starts |= {"transition2.2.0": "transition2", "transition3.3.0": "transition3"}
    for source, path in starts.items():
        yield from conv_norm(f"{prefix}{source}.0", f"{prefix}{source}.1", f"trunk.{path}")
    for stage, modules in zip((2, 3, 4), config.modules, strict=True):
        for m in range(modules):
            yield from _exchange_module(config, stage, m, f"{prefix}stage{stage}.{m}")


def _exchange_module(config: HRNetConfig, stage: int, module: int, source: str) -> NameRows:
    path = f"trunk.stage{stage}.blocks"
    for branch in range(stage):
        for block in range(config.blocks):
            yield from _block(
                f"{source}.branches.{branch}.{block}",
                f"{path}.branches.{branch}.blocks",
                _BASIC,
                (module, block),
            )
    for target in range(stage):
        others = [origin for origin in range(stage) if origin != target]
        for position, origin in enumerate(others):
            names = _fusion_names(f"{source}.fuse_layers.{target}.{origin}", origin, target)
            for name, part in names:
                yield from conv_norm(
                    f"{name}.0", f"{name}.1", f"{path}.fuse.{target}.paths.{position}.{part}", (module,)
                )


def _fusion_names(source: str, origin: int, target: int) -> Iterator[tuple[str, str]]:
    """One convolution up, or one for every halving down."""
    if origin > target:
        yield source, "conv"
    else:
        for i in range(target - origin):
            yield f"{source}.{i}", f"convs.{i}"


def resnet_rows(config: ResNetConfig, prefix: str = "") -> NameRows:
    """List a ResNet under torchvision's names."""
    if config.stem is not Stem.CONVOLUTION:
        raise ValueError(f"a ResNet with the stem {config.stem.value!r} has no counterpart in torchvision")
    frozen = config.frozen_norms is FrozenNorms.STAGE_STARTS
    yield from conv_norm(f"{prefix}conv1", f"{prefix}bn1", "trunk.stem.conv", frozen=frozen)
    parts = _BOTTLENECK if config.bottleneck else _BASIC
    widths = (config.stem_channels, *config.channels)
    for stage, count in enumerate(config.blocks):
        for block in range(count):
            source, path = f"{prefix}layer{stage + 1}.{block}", f"trunk.stages.{stage}.blocks.{block}"
            yield from _block(source, path, parts, frozen=frozen and block == 0)
            if block == 0 and (stage > 0 or widths[0] != widths[1]):
                names = f"{source}.downsample.0", f"{source}.downsample.1"
                yield from conv_norm(*names, f"{path}.shortcut", frozen=frozen)


def _block(
    source: str,
    path: str,
    parts: tuple[tuple[int, str], ...],
    index: tuple[int, ...] = (),
    *,
    frozen: bool = False,
) -> NameRows:
    for number, part in parts:
        names = f"{source}.conv{number}", f"{source}.bn{number}"
        yield from conv_norm(*names, f"{path}.{part}", index, frozen=frozen)
