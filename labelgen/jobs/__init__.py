"""Jobs: resumable work that turns sources into shards."""

__all__: list[str] = []
