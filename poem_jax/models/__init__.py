"""The networks: backbones, root stage, aggregation, decoder, presets."""
