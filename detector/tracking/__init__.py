"""Tracks of vehicles: an online tracker of boxes, tracks of result files, and values per track."""
