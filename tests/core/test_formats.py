"""Predictions from files: the three formats, and what a file can have wrong."""

import gzip
import io
import json
import pickle
import zipfile

import numpy as np
import pytest

from polymerge_core.errors import InputError
from polymerge_core.formats import read_predictions, text

LINE = [[-12.5, 1.8], [3.0, 1.7], [9.0, 1.5]]
RING = [[1.0, 0.0], [3.0, 0.0], [3.0, 2.0], [1.0, 2.0], [1.0, 0.0]]

SUBMISSION = {
    "meta": {"use_camera": True, "output_format": "vector"},
    "results": {
        "a": {"vectors": [LINE, RING], "scores": [0.9, 0.5], "labels": [1, 0], "prop": [False, True]},
        "empty": {"vectors": [], "scores": [], "labels": []},
    },
}
MAPTR = {
    "meta": {"use_camera": True},
    "results": [
        {
            "sample_token": "a",
            "vectors": [
                {"pts": LINE, "pts_num": 3, "cls_name": "divider", "type": 0, "confidence_level": 0.9},
                {"pts": RING, "pts_num": 5, "cls_name": "ped_crossing", "type": 1, "confidence_level": 0.5},
            ],
        },
        {"sample_token": "empty", "vectors": []},
    ],
}
VECTORMAPNET = {
    "meta": {"use_camera": True},
    "results": {
        "a": {
            "vectors": [
                {"pts": LINE, "pts_num": 3, "type": 1, "confidence_level": 0.9},
                {"pts": RING, "pts_num": 5, "type": 0, "confidence_level": 0.5},
            ]
        }
    },
    "groundTruth": {"a": {"vectors": []}, "empty": {"vectors": []}},
}


@pytest.fixture
def write(tmp_path):
    """Write a document as JSON (text and bytes as they are) and return the file's path."""

    def _write(document, name="drive.json"):
        path = tmp_path / name
        if isinstance(document, bytes):
            path.write_bytes(document)
        else:
            path.write_text(document if isinstance(document, str) else json.dumps(document), encoding="utf-8")
        return path

    return _write


def one_frame(**changes):
    frame = {"vectors": [LINE], "scores": [0.9], "labels": [1]} | changes
    return {"results": {"tok": frame}}


def one_record(**changes):
    record = {"pts": LINE, "pts_num": len(LINE), "type": 1, "confidence_level": 0.9} | changes
    return {key: value for key, value in record.items() if value is not None}


# --- the three formats


@pytest.mark.parametrize(
    ("document", "kind"),
    [(SUBMISSION, "ego"), (MAPTR, "lidar"), (VECTORMAPNET, "ego")],
    ids=["submission_vector", "nuscmap_results", "VectorMapNet"],
)
def test_the_same_content_reads_the_same_from_every_format(write, document, kind):
    predictions = read_predictions(write(document))
    assert list(predictions.tokens) == ["a", "empty"]
    np.testing.assert_array_equal(predictions.coordinates, LINE + RING)
    assert predictions.offsets.tolist() == [0, 3, 8]
    assert predictions.frame.tolist() == [0, 0]
    assert predictions.index.tolist() == [0, 1]
    assert predictions.class_name.tolist() == ["divider", "ped_crossing"]
    assert predictions.score.tolist() == [0.9, 0.5]
    assert predictions.frame_kind == kind
    assert predictions.source == "drive"
    assert list(predictions.left_out) == []


def test_z_is_dropped_even_where_it_is_not_a_number(write):
    with_z = [[0.0, 1.0, 5.0], [2.0, 1.0, float("nan")]]
    predictions = read_predictions(write(one_frame(vectors=[with_z])))
    assert predictions.coordinates.tolist() == [[0.0, 1.0], [2.0, 1.0]]


def test_whole_number_coordinates_become_floats(write):
    predictions = read_predictions(write(one_frame(vectors=[[[0, 1], [2, 3]]])))
    assert predictions.coordinates.dtype == np.float64


def test_vectormapnet_frames_are_those_of_results_and_ground_truth(write):
    document = {
        "results": {"b": {"vectors": [one_record()]}},
        "groundTruth": {"c": {"vectors": []}, "b": {"vectors": [one_record(), one_record()]}},
    }
    predictions = read_predictions(write(document))
    assert list(predictions.tokens) == ["b", "c"]
    assert len(predictions.score) == 1


@pytest.mark.parametrize(
    "document",
    [
        {"results": {}},
        {"results": []},
        {"results": {"a": {"vectors": [], "scores": [], "labels": []}}},
        {"results": {"a": {"vectors": []}}},
        {"results": [{"sample_token": "a", "vectors": []}]},
        {"results": {}, "groundTruth": {"a": {"vectors": []}}},
    ],
    ids=["no frames", "no samples", "empty frame", "bare empty frame", "empty sample", "only ground truth"],
)
def test_files_that_saw_nothing_are_read(write, document):
    predictions = read_predictions(write(document))
    assert predictions.coordinates.shape == (0, 2)
    assert predictions.offsets.tolist() == [0]
    assert len(predictions.tokens) == len(document["results"]) + len(document.get("groundTruth", {}))


def test_a_byte_order_mark_is_no_error(write):
    content = b"\xef\xbb\xbf" + json.dumps(SUBMISSION).encode()
    assert list(read_predictions(write(content)).tokens) == ["a", "empty"]


def test_a_frame_without_scores_scores_one(write):
    document = {"results": {"tok": {"vectors": [LINE], "labels": [1]}}}
    assert read_predictions(write(document)).score.tolist() == [1.0]


def test_sample_tokens_that_are_whole_numbers_become_text(write):
    document = {"results": [{"sample_token": 315966253572412943, "vectors": []}]}
    assert list(read_predictions(write(document)).tokens) == ["315966253572412943"]


# --- names and numbers


def maptr(**record):
    return {"results": [{"sample_token": "a", "vectors": [one_record(**record)]}]}


def vectormapnet(**record):
    return {"results": {"a": {"vectors": [one_record(**record)]}}}


@pytest.mark.parametrize(
    ("document", "expected"),
    [
        (maptr(cls_name="divider", type=1), "divider"),
        (maptr(type=0), "divider"),
        (maptr(type=1), "ped_crossing"),
        (maptr(type=2), "boundary"),
        (maptr(cls_name="centerline", type=3), "centerline"),
        (maptr(type=1) | {"meta": {"class_names": ["x", "y"]}}, "y"),
        (maptr(type=1, cls_name="z") | {"meta": {"class_names": ["x", "y"]}}, "z"),
        (vectormapnet(type=0), "ped_crossing"),
        (vectormapnet(type=1), "divider"),
        (vectormapnet(type=2), "boundary"),
        (vectormapnet(type=1, cls_name="kerb"), "kerb"),
        (one_frame(labels=[0]), "ped_crossing"),
        (one_frame(labels=[2]), "boundary"),
        (one_frame(labels=[2.0]), "boundary"),
        (one_frame(labels=["centerline"]), "centerline"),
        (one_frame(labels=[0]) | {"meta": {"class_names": ["divider", "ped_crossing"]}}, "divider"),
    ],
    ids=[
        "MapTR name over number",
        "MapTR 0",
        "MapTR 1",
        "MapTR 2",
        "MapTRv2 centerline",
        "MapTR meta",
        "MapTR name over meta",
        "VectorMapNet 0",
        "VectorMapNet 1",
        "VectorMapNet 2",
        "VectorMapNet name",
        "submission 0",
        "submission 2",
        "submission 2.0",
        "submission name",
        "submission meta",
    ],
)
def test_names_win_over_numbers_and_each_format_has_its_own_order(write, document, expected):
    assert read_predictions(write(document)).class_name.tolist() == [expected]


@pytest.mark.parametrize("label", [3, -1, 1.5, True, None, [1]], ids=repr)
@pytest.mark.parametrize(
    "build", [lambda n: one_frame(labels=[n]), lambda n: maptr(type=n)], ids=["submission", "MapTR"]
)
def test_a_number_without_a_name_is_an_error(write, build, label):
    document = build(label)
    if label is None and "results" in document and isinstance(document["results"], list):
        document["results"][0]["vectors"][0]["type"] = None
    with pytest.raises(InputError, match=r"vector 0.*no name.*class_names"):
        read_predictions(write(document))


# --- vectors that are left out


@pytest.mark.parametrize(
    ("vector", "score", "reason", "length"),
    [
        ([[0.0, 0.0], [float("nan"), 1.0]], 0.9, "a coordinate is not a number", np.nan),
        ([[0.0, 0.0], [float("inf"), float("inf")], [float("inf"), 1.0]], 0.9, "a coordinate is not a number", np.nan),
        ([[0.0, 0.0], [None, 1.0]], 0.9, "a coordinate is not a number", np.nan),
        ([[0.0, 0.0], [10**400, 1.0]], 0.9, "a coordinate is not a number", np.nan),
        ([], 0.9, "fewer than 2 points", 0.0),
        ([[1.0, 1.0]], 0.9, "fewer than 2 points", 0.0),
        ([[0.0, 0.0], [3.0, 4.0]], float("nan"), "score", 5.0),
        ([[0.0, 0.0], [3.0, 4.0]], None, "score", 5.0),
        ([[0.0, 0.0], [3.0, 4.0]], 1.01, "score", 5.0),
        ([[0.0, 0.0], [3.0, 4.0]], -0.1, "score", 5.0),
        ([[-1e308, 0.0], [1e308, 0.0]], 2, "score", np.inf),
    ],
    ids=[
        "NaN", "Infinity", "null", "beyond floats", "no points", "one point",
        "NaN score", "null score", "score above 1", "negative score", "length overflows",
    ],
)  # fmt: skip
def test_a_vector_that_is_no_line_is_left_out_with_a_reason(write, vector, score, reason, length):
    document = one_frame(vectors=[LINE, vector, LINE], scores=[0.9, score, 0.8], labels=[1, 1, 1])
    predictions = read_predictions(write(document))
    assert predictions.index.tolist() == [0, 2]
    assert predictions.score.tolist() == [0.9, 0.8]
    (left_out,) = predictions.left_out
    assert (left_out.token, left_out.position) == ("tok", 1)
    assert reason in left_out.reason
    np.testing.assert_equal(left_out.length_m, length)


def test_scores_of_exactly_0_and_1_are_scores(write):
    document = one_frame(vectors=[LINE, LINE], scores=[0, 1], labels=[1, 1])
    assert read_predictions(write(document)).score.tolist() == [0.0, 1.0]


def test_a_frame_whose_vectors_are_all_left_out_stays_a_frame(write):
    predictions = read_predictions(write(one_frame(vectors=[[]])))
    assert list(predictions.tokens) == ["tok"]
    assert len(predictions.left_out) == 1


# --- files that contradict themselves


@pytest.mark.parametrize(
    ("document", "message"),
    [
        (one_frame(scores=[0.9, 0.8]), r"'tok' has 1 vectors, 2 scores and 1 labels"),
        (one_frame(labels=[]), r"'tok' has 1 vectors, 1 scores and 0 labels"),
        (maptr(pts_num=4), r"'a', vector 0: pts_num is 4, but there are 3 points"),
        (vectormapnet(pts_num=2), r"'a', vector 0: pts_num is 2, but there are 3 points"),
        (one_frame(vectors=[[[0, 0], [1]]]), r"'tok', vector 0: .*equal length"),
        (one_frame(vectors=[[[0, 0], None]]), r"'tok', vector 0: .*equal length"),
        (one_frame(vectors=[[[0, 0, 0, 0], [1, 1, 1, 1]]]), r"'tok', vector 0: .*\[x, y\]"),
        (one_frame(vectors=[[0, 1, 2]]), r"'tok', vector 0: .*\[x, y\]"),
        (one_frame(vectors=[[["0", "1"], ["2", "3"]]]), r"'tok', vector 0: expected numbers"),
        (one_frame(vectors=[[["0", 1], [2, 3]]]), r"'tok', vector 0: expected numbers"),
        (one_frame(vectors=[[[{"x": 1}, 1], [2, 3]]]), r"'tok', vector 0: expected numbers"),
        (one_frame(vectors=["abc"]), r"'tok', vector 0 must be a list, not text"),
        (one_frame(vectors={"0": LINE}), r"'tok', vectors must be a list, not an object"),
        (one_frame(scores=["0.9"]), r"'tok', scores: expected numbers"),
        (one_frame(scores=[[0.9]]), r"'tok', scores: expected one number"),
        (one_frame(scores=0.9), r"'tok', scores must be a list"),
        (one_frame(labels=[""]), r"'tok', vector 0: the name '' is empty"),
        (one_frame(labels=["a\0b"]), r"no layer can store"),
        ({"results": {"tok": None, "b": SUBMISSION["results"]["a"]}}, r"'tok' must be an object, not null"),
        ({"results": {"tok": {"vectors": [LINE], "scores": [1]}}}, r"'tok' has no 'labels'; its keys are"),
        ({"results": {"": {"vectors": [], "labels": []}}}, r"the name '' is empty"),
        ({"results": {"\ud800": {"vectors": [], "labels": []}}}, r"no layer can store"),
        (maptr(cls_name=None, type=None), r"'a', vector 0 has no 'type'"),
        (maptr(pts=None), r"'a', vector 0 has no 'pts'"),
        ({"results": [{"vectors": []}]}, r"entry 0 has no 'sample_token'"),
        ({"results": [{"sample_token": 1.5, "vectors": []}]}, r"sample_token must be text"),
        ({"results": [MAPTR["results"][1], MAPTR["results"][1]]}, r"frame 'empty' stands twice"),
        (SUBMISSION | {"meta": {"class_names": "divider"}}, r"class_names in meta must be a list"),
        (
            SUBMISSION | {"meta": {"class_names": ["divider", 1]}},
            r"class_names in meta, entry 1 must be text",
        ),
        ({"type": "FeatureCollection", "features": []}, r"not a file of predictions.*'features'"),
        ([1, 2], r"not a file of predictions"),
        ({"results": 3}, r"not a file of predictions"),
    ],
)
def test_a_file_that_contradicts_itself_is_an_error_that_says_where(write, document, message):
    path = write(json.dumps(document))
    with pytest.raises(InputError, match=message) as caught:
        read_predictions(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


# --- files that are not strict JSON


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"results": {"a": {"vectors": [}', r"not valid JSON at line 1, column 32"),
        ('{"results":\n {}', r"not valid JSON at line 2, column 4"),
        ('{"results": {}} trailing', r"not valid JSON at line 1, column 17 \(Extra data\)"),
        ('{"results": {"a": {}, "a": {}}}', r"the key 'a' stands twice"),
        ("[" * 200_000, r"nested too deep"),
        ('{"results": ' + "9" * 5000 + "}", r"a number that cannot be read|not a file of predictions"),
        ("", r"is empty"),
        (" \n", r"is empty"),
        (b'{"results": "\xe9"}', r"byte 13 is not UTF-8"),
        ("{}".encode("utf-16"), r"is not UTF-8"),
    ],
    ids=[
        "syntax", "cut off", "trailing", "duplicate key", "deep", "long number", "zero bytes", "blank",
        "latin-1", "utf-16",
    ],
)  # fmt: skip
def test_what_is_not_strict_json_is_refused_with_its_place(write, content, message):
    with pytest.raises(InputError, match=message):
        read_predictions(write(content))


def archive():
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as target:
        target.writestr("data.pkl", b"\x80\x04.")
    return buffer.getvalue()


def numpy_file():
    buffer = io.BytesIO()
    np.save(buffer, np.zeros(2))
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "name", "why"),
    [
        *[(pickle.dumps(SUBMISSION, protocol), "r.json", "runs whatever code") for protocol in range(6)],
        (pickle.dumps([1], 0), "r.json", "runs whatever code"),
        (b"{}", "results.pkl", "runs whatever code"),
        (b"{}", "results.PICKLE", "runs whatever code"),
        (b"{}", "weights.pth", "holds a pickle"),
        (numpy_file(), "r.json", "pickled objects"),
        (b"{}", "r.npy", "pickled objects"),
        (b"{}", "r.npz", "pickled objects"),
        (archive(), "r.json", "unpack to any size"),
        (b"{}", "r.zip", "unpack to any size"),
        (gzip.compress(b"{}", mtime=0), "r.json", "unpack to any size"),
        (b"{}", "r.json.gz", "unpack to any size"),
        (b"ARROW1\0\0", "poses.json", "Arrow"),
    ],
)
def test_what_can_run_code_or_unpack_is_refused_with_reason_and_remedy(write, content, name, why):
    with pytest.raises(InputError, match=rf"{why}.*(converter in the README|unpack it|as CSV)"):
        read_predictions(write(content, name))


def test_a_pickle_is_never_loaded(write, tmp_path):
    class Attack:
        def __reduce__(self):
            return (open, (str(tmp_path / "touched"), "w"))

    with pytest.raises(InputError, match="pickle"):
        read_predictions(write(pickle.dumps(Attack())))
    assert not (tmp_path / "touched").exists()


def test_a_file_that_is_too_large_is_refused_unread(write, monkeypatch):
    monkeypatch.setattr(text, "MAX_BYTES", 10)
    with pytest.raises(InputError, match="the limit is"):
        read_predictions(write(SUBMISSION))


def test_a_sparse_file_over_2_gib_is_refused_at_once(tmp_path):
    path = tmp_path / "huge.json"
    with path.open("wb") as file:
        file.truncate(2 * 1024**3 + 1)
    with pytest.raises(InputError, match=r"2\.0 GiB"):
        read_predictions(path)


def test_missing_files_and_folders_are_one_sentence(tmp_path):
    with pytest.raises(InputError, match="there is no such file"):
        read_predictions(tmp_path / "none.json")
    with pytest.raises(InputError, match="is a folder"):
        read_predictions(tmp_path)
