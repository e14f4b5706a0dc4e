"""Vehicle bodies fitted to silhouettes: placed on the road, turned along VP1, moved, scaled and stretched.

Silhouettes of one vehicle share its size and proportions, and each has a position of its own. Outlines are compared as
convex hulls through their support function: how far each reaches in evenly spread directions. The type of a vehicle and
its direction of travel are unknown: every such hypothesis is fitted beside the others, one pair of vehicle and
hypothesis at a time.

Source: Sochor et al., CVIU 2017 (models aligned with detections); the fit is this project's.
"""
