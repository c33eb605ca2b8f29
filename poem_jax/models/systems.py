"""Which module belongs to which configuration: the one list of the systems that this package has.

A system is a config class (`ModelConfig` in `config.py` says what it tells) and one file with its module
(`System` in `network.py` says what it has). Configs load without their modules.
"""

from poem_jax.models.config import Config, ModelConfig
from poem_jax.models.mesh_transformer_config import MeshTransformerConfig
from poem_jax.models.mvp_config import MvpConfig
from poem_jax.models.poem_v1_config import PoemV1Config

MODULES: dict[type[ModelConfig], str] = {
    Config: "poem_jax.models.poem_v2:Poem",
    PoemV1Config: "poem_jax.models.poem_v1:PoemV1",
    MeshTransformerConfig: "poem_jax.models.mesh_transformers:MeshTransformer",
    MvpConfig: "poem_jax.models.mvp:Mvp",
}
"""`file:class` of the module, by config class, whose name is the `kind` of saved configs."""
