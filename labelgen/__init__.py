"""labelgen: training labels for monocular 3D vehicle detection and speed measurement from traffic cameras."""

__version__ = "0.1.0"
