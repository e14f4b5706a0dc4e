"""Frames: read videos, folders of images and camera streams; write videos."""
