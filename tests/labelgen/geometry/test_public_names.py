"""The public names of the geometry room are a promise; adding one is a decision, removing one breaks users."""

import labelgen.geometry


def test_public_names_are_these():
    assert labelgen.geometry.__all__ == [
        "Camera",
        "EncodedBoxes",
        "MaskLabels",
        "Pair",
        "Rectification",
        "RectifiedOutline",
        "Region",
        "RoadMask",
        "Rule",
        "cuboid_sizes",
        "decode_boxes",
        "encode_boxes",
        "front_bottom_midpoints",
        "label_outlines",
        "mask_outline",
        "mask_polygon",
        "parse_size",
        "rectified_outline",
        "rectify_windows",
        "reorder_vertices",
        "road_cuboids",
        "tangent_boxes",
        "window_around",
    ]
    assert all(hasattr(labelgen.geometry, name) for name in labelgen.geometry.__all__)
