"""Scale of a calibrated camera, metres per road unit: from vehicle bodies, mean dimensions or known distances."""
