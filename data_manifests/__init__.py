"""Data manifests, read by `labelgen.datasets.manifest`: one TOML per data set."""
