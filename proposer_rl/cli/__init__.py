"""The commands; the only modules that see Hydra."""
