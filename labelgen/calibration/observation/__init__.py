"""Observations of one pass over a video: feature tracks, edgelets, silhouettes, camera motion and the background."""
