"""Vanishing points and focal length.

VP1 (along the road) comes from feature tracks, VP2 (across it) and the focal length from edges. A bundle adjustment
over silhouettes improves all of them.
"""
