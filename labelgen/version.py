"""The version of the package, as it stands in shards, checkpoints and files."""

__all__ = ["__version__"]

__version__ = "0.1.0"
