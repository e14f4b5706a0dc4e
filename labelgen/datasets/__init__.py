"""Published data sets: their manifests, layouts and ground truth."""
