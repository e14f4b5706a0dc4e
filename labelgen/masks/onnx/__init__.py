"""Masks from a network in an ONNX file, whatever tool exported it."""
