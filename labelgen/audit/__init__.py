"""The audit: a page with contact sheets, figures and statistics by which labels are judged by eye."""

__all__: list[str] = []
