"""Configuration of DETR's decoder, which the mesh transformers and POEM v1's ablation without its
Point-Embedded Transformer share."""

from dataclasses import dataclass

from poem_jax.models.config import MAX_LAYERS, require, require_counts


@dataclass(frozen=True)
class DetrConfig:
    """Decoder of DETR (Carion et al. 2020). The paper gives no numbers; these are the release's."""

    num_layers: int = 6
    num_heads: int = 8
    ffn_width: int = 2048
    """Hidden channels of the feed-forward network."""
    dropout: float = 0.1
    """Share of numbers dropped in training: of attention weights, of what is added to the embeddings, and of
    the feed-forward network's hidden channels."""

    def __post_init__(self) -> None:
        require_counts(self, "num_layers", most=MAX_LAYERS)
        require_counts(self, "num_heads", "ffn_width")
        require(0 <= self.dropout < 1, f"`dropout` must be in [0, 1); got {self.dropout}")
