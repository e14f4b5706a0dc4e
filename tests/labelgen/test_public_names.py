"""The public names of the rooms that users import from: adding one is a decision, removing one breaks users."""

from __future__ import annotations

from importlib import import_module

import pytest

PUBLIC_NAMES = {
    "labelgen.geometry": """
        Camera EncodedBoxes MaskLabels Pair Rectification RectifiedOutline Region RoadMask Rule
        cuboid_sizes decode_boxes encode_boxes front_bottom_midpoints label_outlines mask_outline mask_polygon
        parse_size rectified_outline rectify_windows reorder_vertices road_cuboids tangent_boxes window_around
    """,
    "labelgen.labeling": """
        BoxLimits FrameLabels LabelLimits MaskReject SeenFrame flat_labels label_boxes label_masks label_passages
    """,
    "labelgen.shards": """
        DatasetSummary Reject ShardDataset ShardReader ShardSet ShardWriter
        find_shards merge_shards read_index summarise validate_shard validate_shards write_index
    """,
    "labelgen.labels": "Flag IgnoreReason IgnoredBoxes Labels MIN_IGNORED_SHARE Sample Split VehicleClass",
}


@pytest.mark.parametrize("room", PUBLIC_NAMES)
def test_public_names_are_these(room: str) -> None:
    module = import_module(room)
    assert sorted(module.__all__) == sorted(PUBLIC_NAMES[room].split())
    assert all(hasattr(module, name) for name in module.__all__)
