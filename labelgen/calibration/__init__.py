"""Calibration of a fixed camera from its video alone.

`observation/` gathers tracks, edges and silhouettes in one pass over the video. `vanishing/` estimates the vanishing
points and the focal length from them, `scale/` the metres per road unit. `pipeline` runs all of it.
"""
