"""The `labelgen` command: one file per command; resolves inputs, calls the library, prints."""
