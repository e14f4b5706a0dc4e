"""Calibration from the video alone: vanishing points, focal length, scale and road mask."""
