"""Ready-made masks in COCO JSON."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pycocotools import mask as coco

from labelgen.errors import DataError, LabelgenError
from labelgen.labels import VehicleClass
from labelgen.masks import Clip, InstanceMasks, MaskOptions, check_masks, create_mask_source
from labelgen.masks.class_names import parse_classes
from labelgen.masks.coco_segmentation import check_segmentation, decode_segmentation

WH = (64, 48)
IMAGE = np.zeros((48, 64, 3), dtype=np.uint8)
CATEGORIES = [{"id": 1, "name": "Car"}, {"id": 2, "name": "person"}, {"id": 9, "name": "lorry"}]


def rectangle(x0: int, y0: int, x1: int, y1: int) -> np.ndarray:
    mask = np.zeros((WH[1], WH[0]), dtype=np.uint8)
    mask[y0:y1, x0:x1] = 1
    return mask


def compressed(mask: np.ndarray) -> dict[str, Any]:
    rle = coco.encode(np.asfortranarray(mask))
    return {"size": rle["size"], "counts": rle["counts"].decode()}


def uncompressed(mask: np.ndarray) -> dict[str, Any]:
    flat = np.concatenate([[0], mask.ravel(order="F"), [2]])
    counts = np.diff(np.concatenate([[0], np.flatnonzero(flat[1:] != flat[:-1])]))
    return {"size": list(mask.shape), "counts": ([0] if mask[0, 0] else []) + [int(c) for c in counts if c]}


def polygon(x0: int, y0: int, x1: int, y1: int) -> list[list[float]]:
    return [[x0, y0, x1, y0, x1, y1, x0, y1]]


def annotation(index: int, image: Any, segmentation: Any, category: Any = 1, **more: Any) -> dict[str, Any]:
    return {"id": index, "image_id": image, "category_id": category, "segmentation": segmentation, **more}


def write(path: Path, data: Any) -> str:
    path.write_text(json.dumps(data))
    return f"coco:{path}"


def masks_of(source: Any, number: int = -1, name: str = "") -> InstanceMasks:
    masks: InstanceMasks = source.masks([IMAGE], [number], [name])[0]
    return masks


@pytest.mark.parametrize("encode", [compressed, uncompressed])
def test_rle_and_polygons_give_the_same_mask(tmp_path: Path, encode: Any) -> None:
    data = {
        "images": [{"id": 7, "frame": 25, "width": 64, "height": 48}],
        "categories": CATEGORIES,
        "annotations": [
            annotation(1, 7, encode(rectangle(5, 10, 25, 20)), score=0.75),
            annotation(2, 7, polygon(5, 10, 25, 20), 9),
        ],
    }
    source = create_mask_source(write(tmp_path / "m.json", data), frame_wh=WH)
    masks = masks_of(source, 25)
    assert masks.boxes_xyxy.tolist() == [[5, 10, 25, 20]] * 2
    assert all(crop.all() for crop in masks.crops)
    assert masks.class_ids.tolist() == [VehicleClass.CAR, VehicleClass.TRUCK]
    assert masks.scores.tolist() == [0.75, 1.0]
    assert len(masks_of(source, 26)) == 0
    assert source.problems == []


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 70), st.integers(1, 70), st.floats(0.02, 0.98))
def test_rle_decodes_like_pycocotools(seed: int, w: int, h: int, density: float) -> None:
    mask = (np.random.default_rng(seed).random((h, w)) < density).astype(np.uint8)
    mask[:, : w // 3] = 0
    if not mask.any():
        mask[-1, -1] = 1
    for rle in (compressed(mask), uncompressed(mask)):
        (x, y), crop = decode_segmentation(rle, (w, h))
        whole = np.zeros_like(mask)
        whole[y : y + crop.shape[0], x : x + crop.shape[1]] = crop
        np.testing.assert_array_equal(whole, mask)


@settings(deadline=None, max_examples=60)
@given(st.lists(st.tuples(st.floats(-20, 84), st.floats(-20, 68)), min_size=3, max_size=8))
def test_polygons_decode_like_pycocotools(points: list[tuple[float, float]]) -> None:
    # Whole coordinates as pycocotools rounds away from zero outside the frame.
    flat = [float(round(v)) for point in points for v in point]
    expected = coco.decode(coco.frPyObjects([flat], WH[1], WH[0]))[..., 0]
    if not expected.any():
        return
    (x, y), crop = decode_segmentation([flat], WH)
    whole = np.zeros_like(expected)
    whole[y : y + crop.shape[0], x : x + crop.shape[1]] = crop
    # Edges that leave the frame may be drawn a pixel apart, by pycocotools' own rounding.
    assert (whole != expected).sum() <= 0.02 * expected.size


@pytest.mark.parametrize(
    ("images", "number", "name", "expected"),
    [
        ([{"id": 3, "frame": 5}, {"id": 4, "frame": 6}], 6, "", 4),
        ([{"id": 3, "frame": 5, "file_name": "000006.jpg"}, {"id": 4, "frame": 6}], 6, "", 4),
        ([{"id": 3, "file_name": "000123.jpg"}], 123, "", 3),
        ([{"id": 3, "file_name": "out/cam2_000123.jpg"}], 123, "", 3),
        ([{"id": 3, "file_name": "b.png"}, {"id": 4, "file_name": "a.png"}], 0, "b.png", 3),
        ([{"id": 3, "file_name": "left/1.png"}, {"id": 4, "file_name": "right/1.png"}], 0, "right/1.png", 4),
        ([{"id": 3, "file_name": "deep/down/b.png"}], 0, "b.png", 3),
        ([{"id": 3, "file_name": "deep\\b.png"}], 0, "b.png", 3),
        ([{"id": "text", "file_name": "b.png"}], 0, "b.png", "text"),
        # A number in a file name says nothing about another file of a folder.
        ([{"id": 3, "file_name": "1.png"}], 1, "other.png", None),
    ],
)
def test_finds_the_image_entry(
    tmp_path: Path, images: list[dict[str, Any]], number: int, name: str, expected: Any
) -> None:
    annotations = [annotation(i, entry["id"], polygon(i, 0, i + 5, 9), 3) for i, entry in enumerate(images)]
    source = create_mask_source(write(tmp_path / "m.json", {"images": images, "annotations": annotations}))
    masks = masks_of(source, number, name)
    lefts = [i for i, entry in enumerate(images) if entry["id"] == expected]
    assert masks.boxes_xyxy[:, 0].tolist() == lefts


def test_list_of_results_with_coco_ids(tmp_path: Path) -> None:
    results = [
        annotation(i, 40, compressed(rectangle(i, 2, i + 9, 20)), category, score=0.9)
        for i, category in enumerate([3, 4, 6, 8, 1])
    ]
    source = create_mask_source(write(tmp_path / "r.json", results))
    expected = [VehicleClass.CAR, VehicleClass.MOTORCYCLE, VehicleClass.BUS, VehicleClass.TRUCK]
    assert masks_of(source, 40).class_ids.tolist() == expected
    assert source.problems == ["r.json: 1 annotation of other categories (1 id 1) left out"]


def test_other_categories_are_counted_and_low_scores_left_out(tmp_path: Path) -> None:
    square = polygon(1, 1, 9, 9)
    data = {
        "images": [{"id": 1, "frame": 0}],
        "categories": CATEGORIES,
        "annotations": [
            annotation(1, 1, square, 2),
            annotation(2, 1, square, 2),
            annotation(3, 1, square, 1, score=0.4),
            annotation(4, 1, square, 1, iscrowd=1),
            annotation(5, 1, square, 1, score=0.6),
            annotation(6, 1, square, 3),
            annotation(7, 1, square, 4, score=0.1),
        ],
    }
    source = create_mask_source(write(tmp_path / "m.json", data), score_threshold=0.5)
    assert masks_of(source, 0).scores.tolist() == pytest.approx([0.6])
    assert source.problems == [
        "m.json: 4 annotations of other categories (2 person, 1 id 3, 1 id 4) left out",
        "m.json: 1 crowd region left out",
        "m.json: 1 annotation with a score below 0.5 left out",
    ]


BROKEN: list[tuple[Any, str]] = [
    (annotation(9, 1, None), "no segmentation"),
    (annotation(9, 1, []), "no segmentation"),
    (annotation(9, 1, [[1, 1, 9, 9]]), "three x, y pairs"),
    (annotation(9, 1, [[1, 1, 9, "x", 3, 4]]), "no numbers"),
    (annotation(9, 1, [[1, 1, 1e12, 9, 3, 4]]), "far outside"),
    (annotation(9, 1, polygon(70, 5, 90, 20)), "outside the frame"),
    (annotation(9, 1, {"size": [10, 10], "counts": [0, 100]}), "made for frames of 10x10 px, but the frames are 64x48"),
    (annotation(9, 1, {"size": [48, 64], "counts": [10, 20]}), "covers 30 of 3072"),
    (annotation(9, 1, {"size": [48, 64], "counts": [3072]}), "empty"),
    (annotation(9, 1, {"size": [48, 64], "counts": [4000, -928]}), "no usable counts"),
    (annotation(9, 1, {"size": [48, 64], "counts": "\u00e9 !"}), "characters that are no run lengths"),
    (annotation(9, 1, {"size": [48, 64], "counts": "ooooooooooooooooo"}), "beyond any frame"),
    (annotation(9, 1, {"size": [48, 64]}), "no usable counts"),
    (annotation(9, 1, {"size": [48, 64], "counts": "oo"}), "cut off"),
    (annotation(9, 1, {"size": [48, 64], "counts": ""}), "covers 0 of 3072"),
    (annotation(9, 1, {"size": [48, 64], "counts": [10**400]}), "RLE has no usable counts"),
    (annotation(9, 1, {"size": [48, 64], "counts": compressed(rectangle(1, 1, 9, 9))["counts"][:-1]}), "its RLE"),
    (annotation(9, 1, [[1, 1, 10**400, 9, 3, 4]]), "no numbers or far outside"),
    (annotation(9, 1, [[5.1, 5, 5.3, 5, 5.3, 40, 5.1, 40]]), "its mask is empty"),
    (annotation(9, 1, polygon(1, 1, 9, 9), score=10**400), "is not in [0, 1]"),
    (annotation("\ud800", 1, None), "no segmentation"),
    (annotation(9, 1, polygon(1, 1, 9, 9), score=7), "score 7 is not in"),
    (annotation(9, 1, polygon(1, 1, 9, 9), score="high"), "score 'high' is not in"),
    (annotation(9, 55, polygon(1, 1, 9, 9)), "no image with id 55"),
    (annotation(9, None, polygon(1, 1, 9, 9)), "no image with id None"),
    (annotation(9, 1, polygon(1, 1, 9, 9), "car"), "category_id 'car' is not a number"),
    ("nonsense", "not a JSON object"),
]


@pytest.mark.parametrize(("broken", "reason"), BROKEN, ids=[reason for _, reason in BROKEN])
def test_broken_annotations_are_skipped_with_a_reason(tmp_path: Path, broken: Any, reason: str) -> None:
    data = {
        "images": [{"id": 1, "frame": 0}],
        "categories": CATEGORIES,
        "annotations": [broken, annotation(10, 1, polygon(20, 20, 30, 30))],
    }
    source = create_mask_source(write(tmp_path / "m.json", data), frame_wh=WH)
    # Known before the first frame, so that an interrupted job that continues reports the same.
    problems = list(source.problems)
    assert len(problems) == 1
    assert reason in problems[0]
    problems[0].encode()
    for _ in range(2):
        assert masks_of(source, 0).boxes_xyxy.tolist() == [[20, 20, 30, 30]]
    assert source.problems == problems
    late = create_mask_source(write(tmp_path / "m.json", data))
    masks_of(late, 77)
    assert late.problems == problems


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "not a JSON file"),
        ("{", "not a JSON file"),
        ("[" * 100_000, "not a JSON file"),
        ("3", "not COCO"),
        ("[1, 2]", "not COCO"),
        ('{"images": []}', "not COCO"),
        ('{"images": 3, "annotations": []}', "not COCO"),
        ('{"images": [], "annotations": [], "categories": [{"id": 1, "name": "dog"}]}', "none of its categories"),
    ],
)
def test_files_that_are_no_coco_are_refused(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "m.json").write_text(content)
    with pytest.raises(DataError, match=message) as caught:
        create_mask_source(f"coco:{tmp_path / 'm.json'}")
    assert "\n" not in str(caught.value)


def test_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        create_mask_source(f"coco:{tmp_path / 'none.json'}")


def test_another_frame_size_is_reported_once(tmp_path: Path) -> None:
    data = {"images": [{"id": i, "frame": i, "width": 1920, "height": 1080} for i in range(5)], "annotations": []}
    source = create_mask_source(write(tmp_path / "m.json", data), frame_wh=WH)
    assert len(source.problems) == 1
    assert "1920x1080 px, but the frames are 64x48" in source.problems[0]


def test_a_file_name_of_many_digits_is_no_frame_number(tmp_path: Path) -> None:
    images = [{"id": 1, "file_name": "9" * 5000 + ".jpg"}, {"id": 2, "file_name": "a3.jpg"}]
    annotations = [annotation(1, 2, polygon(1, 1, 9, 9), 3)]
    source = create_mask_source(write(tmp_path / "m.json", {"images": images, "annotations": annotations}))
    assert len(masks_of(source, 3)) == 1


@settings(deadline=None, max_examples=40)
@given(st.lists(st.tuples(st.floats(-20, 84), st.floats(-20, 68)), min_size=3, max_size=6), st.floats(0.01, 1))
def test_what_passes_the_check_can_be_decoded_and_nothing_else(
    points: list[tuple[float, float]], squeeze: float
) -> None:
    flat = [v for x, y in points for v in (30 + (x - 30) * squeeze**3, y)]
    try:
        check_segmentation([flat], WH)
    except ValueError as error:
        with pytest.raises(ValueError, match=re.escape(str(error))):
            decode_segmentation([flat], WH)
    else:
        assert decode_segmentation([flat], WH)[1].any()


SQUARE = compressed(rectangle(5, 10, 25, 20))


@pytest.mark.parametrize("convert", [float, str, lambda n: f"{n}.0", lambda n: f" {n} "])
@pytest.mark.parametrize("key", ["image", "annotation", "category", "annotation's category"])
def test_ids_may_be_floats_or_text(tmp_path: Path, convert: Any, key: str) -> None:
    data = {
        "images": [{"id": convert(7) if key == "image" else 7, "file_name": "f_000003.jpg"}],
        "categories": [{"id": convert(3) if key == "category" else 3, "name": "truck"}],
        "annotations": [
            annotation(
                1,
                convert(7) if key == "annotation" else 7,
                SQUARE,
                convert(3) if key == "annotation's category" else 3,
            )
        ],
    }
    source = create_mask_source(write(tmp_path / "m.json", data), frame_wh=WH)
    assert masks_of(source, 3).class_ids.tolist() == [VehicleClass.TRUCK]
    assert source.problems == []


@pytest.mark.parametrize("image_id", ["frame_000003", "out/frame_000003", "000003", "frame_000003.png"])
def test_image_ids_of_results_may_be_file_names(tmp_path: Path, image_id: str) -> None:
    source = create_mask_source(write(tmp_path / "r.json", [annotation(1, image_id, SQUARE, 3, score="0.75")]))
    assert masks_of(source, 3).scores.tolist() == [0.75]
    by_name = create_mask_source(write(tmp_path / "r.json", [annotation(1, image_id, SQUARE, 3)]))
    assert len(masks_of(by_name, 0, f"{Path(image_id).stem}.jpg")) == 1


def test_annotations_may_name_their_image_by_its_file(tmp_path: Path) -> None:
    data = {"images": [{"id": 7, "file_name": "a/f_3.jpg"}], "annotations": [annotation(1, "f_3", SQUARE, 3)]}
    assert len(masks_of(create_mask_source(write(tmp_path / "m.json", data)), 3)) == 1


@pytest.mark.parametrize("mark", [1, True, 1.0, "1"])
def test_crowds_are_single_masks_where_there_is_little_else(tmp_path: Path, mark: Any) -> None:
    crowds = [annotation(k, 1, SQUARE, iscrowd=mark) for k in range(3)]
    data = {"images": [{"id": 1, "frame": 0}], "categories": CATEGORIES, "annotations": crowds}
    source = create_mask_source(write(tmp_path / "m.json", data))
    assert len(masks_of(source, 0)) == 3
    assert source.problems == ["m.json: 3 annotations marked as crowds: taken as single masks"]
    data["annotations"] = [*crowds, *(annotation(k, 1, polygon(1, 1, 9, 9)) for k in range(10, 14))]
    source = create_mask_source(write(tmp_path / "m.json", data))
    assert len(masks_of(source, 0)) == 4
    assert source.problems == ["m.json: 3 crowd regions left out"]


@pytest.mark.parametrize("factor", [0.5, 2, 3])
@pytest.mark.parametrize("form", ["polygon", "compressed", "uncompressed"])
def test_masks_of_another_size_are_scaled_where_that_is_allowed(tmp_path: Path, factor: float, form: str) -> None:
    box = [4, 10, 26, 20]
    w, h = round(WH[0] * factor), round(WH[1] * factor)
    x0, y0, x1, y1 = (round(v * factor) for v in box)
    mask = np.zeros((h, w), np.uint8)
    mask[y0:y1, x0:x1] = 1
    encoded = {"polygon": polygon(x0, y0, x1, y1), "compressed": compressed(mask), "uncompressed": uncompressed(mask)}
    data = {
        "images": [{"id": 1, "frame": 0, "width": w, "height": h}],
        "annotations": [annotation(k, 1, encoded[form], 3) for k in range(5)],
    }
    path = write(tmp_path / "m.json", data)
    scaled = create_mask_source(path, frame_wh=WH, options=MaskOptions(scale_masks=True))
    assert masks_of(scaled, 0).boxes_xyxy.tolist() == [box] * 5
    assert scaled.problems == []
    # One line, whatever form the masks have.
    refused = create_mask_source(path, frame_wh=WH, clip=Clip(Path("v.mp4"), WH, 1))
    (line,) = refused.problems
    assert f"5 masks made for frames of {w}x{h} px, but the frames are 64x48 (with scale_masks they are scaled)" in line
    with pytest.raises(DataError, match="no vehicles found, no mask in it can be used: 5 masks") as caught:
        check_masks(refused)
    assert caught.value.parameters == ("scale_masks",)


def test_masks_of_another_ratio_are_never_scaled(tmp_path: Path) -> None:
    data = {
        "images": [{"id": 1, "frame": 0, "width": 48, "height": 64}],
        "annotations": [annotation(1, 1, polygon(1, 1, 9, 9), 3)],
    }
    source = create_mask_source(
        write(tmp_path / "m.json", data), clip=Clip(Path("v.mp4"), WH, 1), options=MaskOptions(scale_masks=True)
    )
    assert len(masks_of(source, 0)) == 0
    assert "another ratio, so they cannot be scaled" in source.problems[0]


def test_polygons_of_an_unknown_size_that_leave_the_frame_are_refused(tmp_path: Path) -> None:
    data = {
        "images": [{"id": 1, "frame": 0}],
        "annotations": [annotation(k, 1, polygon(5 + 4 * k, 5, 20 + 4 * k, 40), 3) for k in range(25)],
    }
    source = create_mask_source(write(tmp_path / "m.json", data), frame_wh=WH)
    assert len(masks_of(source, 0)) == 0
    (line,) = source.problems
    assert line.startswith("m.json: 25 annotations skipped: its polygon has no announced size, and such polygons reach")


def test_bad_annotations_are_one_line_for_each_kind(tmp_path: Path) -> None:
    bad = [annotation(k, 1, None) for k in range(1000)] + [annotation(k, 99 + k, SQUARE) for k in range(1000)]
    data = {
        "images": [{"id": 1, "frame": 0}],
        "categories": CATEGORIES,
        "annotations": [*bad, annotation(5, 1, SQUARE)],
    }
    source = create_mask_source(write(tmp_path / "m.json", data), frame_wh=WH)
    assert source.problems == [
        "m.json: 1000 annotations skipped: no image of this id, such as annotation 0: no image with id 99",
        "m.json: 1000 annotations skipped: it has no segmentation, such as annotation 0: it has no segmentation",
    ]


def test_class_ids_from_0_without_categories_need_their_meaning(tmp_path: Path) -> None:
    path = write(tmp_path / "r.json", [annotation(1, 0, SQUARE, 2), annotation(2, 0, SQUARE, 0)])
    with pytest.raises(DataError, match=r"class ids begin with 0, .* say what they mean, as 2=car") as caught:
        create_mask_source(path)
    assert caught.value.parameters == ("classes",)
    source = create_mask_source(path, options=MaskOptions(classes=parse_classes("2=car")))
    assert masks_of(source, 0).class_ids.tolist() == [VehicleClass.CAR]
    assert source.problems == ["r.json: 1 annotation of other categories (1 id 0) left out"]


def test_class_ids_that_are_no_vehicles_by_coco_are_told(tmp_path: Path) -> None:
    source = create_mask_source(write(tmp_path / "r.json", [annotation(k, 0, SQUARE, 2) for k in range(3)]))
    assert any("say what they mean with classes, as 2=car" in line for line in source.problems)


def test_classes_name_other_categories(tmp_path: Path) -> None:
    data = {
        "images": [{"id": 1, "frame": 0}],
        "categories": [{"id": 1, "name": "SUV"}, {"id": 2, "name": "car"}, {"id": 5, "name": "x"}],
        "annotations": [annotation(k, 1, SQUARE, c) for k, c in enumerate([1, 2, 5])],
    }
    path = write(tmp_path / "m.json", data)
    source = create_mask_source(path, options=MaskOptions(classes=parse_classes("suv=car, 5=bus")))
    assert masks_of(source, 0).class_ids.tolist() == [VehicleClass.CAR, VehicleClass.CAR, VehicleClass.BUS]
    with pytest.raises(DataError, match="it has no category jeep"):
        create_mask_source(path, options=MaskOptions(classes=parse_classes("jeep=car")))


@pytest.mark.parametrize("text", ["", "car", "2=", "=car", "2=boat", "2=car,,3=bus"])
def test_classes_of_another_form_are_refused(text: str) -> None:
    with pytest.raises(LabelgenError, match="as 2=car,7=truck,pickup=car") as caught:
        parse_classes(text)
    assert caught.value.parameters == ("classes",)


def test_options_of_a_file_are_for_coco_only() -> None:
    with pytest.raises(LabelgenError, match="only masks coco:FILE take that, not masks background") as caught:
        create_mask_source("background", options=MaskOptions(first_frame=1))
    assert caught.value.parameters == ("first_frame",)


def test_options_survive_being_written() -> None:
    options = MaskOptions(1, True, parse_classes("2=car,suv=bus"))
    assert MaskOptions.from_dict(json.loads(json.dumps(options.describe()))) == options
    assert MaskOptions.from_dict(MaskOptions().describe()) == MaskOptions()
    assert MaskOptions().describe() == {}
    with pytest.raises(DataError, match="not as they were written"):
        MaskOptions.from_dict({"classes": {"a": 77}})


def test_a_byte_order_mark_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "r.json").write_text(json.dumps([annotation(1, 0, SQUARE, 3)]), encoding="utf-8-sig")
    assert len(masks_of(create_mask_source(f"coco:{tmp_path / 'r.json'}"), 0)) == 1
