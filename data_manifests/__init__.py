"""Data manifests, read by `labelgen.manifest`: one TOML per data set."""
