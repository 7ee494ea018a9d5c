"""Camera assignment: whom each block gets, and what is kept of it."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from support.assignment import CONFIG, MODES, camera, hand_made, scene, skyward, strips
from vdgs.errors import RunError
from vdgs.kernels import cpu as kernels
from vdgs.partition.assignment.assign_cameras import (
    ABOVE_THRESHOLD,
    BEST_BLOCK,
    NOT_ASSIGNED,
    TOPPED_UP,
    assign_cameras,
    assignment_rows,
    explain_assignment,
    make_assignment_table,
)
from vdgs.partition.assignment.score_file import load_scores, save_scores
from vdgs.partition.assignment.score_matrix import compute_score_matrix
from vdgs.partition.block_records import BlockCamerasRecord
from vdgs.system.records import record_from_dict, record_to_dict

# Whom each block gets

matrices = st.integers(0, 12).flatmap(
    lambda c: st.integers(1, 5).flatmap(
        lambda b: st.tuples(
            st.lists(st.lists(st.sampled_from([0.0, 0.2, 0.5, 1.0]), min_size=b, max_size=b), min_size=c, max_size=c),
            st.lists(st.lists(st.integers(0, 2), min_size=b, max_size=b), min_size=c, max_size=c),
        ).map(lambda pair: (np.reshape(pair[0], (c, b)), np.reshape(pair[1], (c, b))))
    )
)


@settings(max_examples=150)
@given(matrices, st.sampled_from(MODES), st.integers(0, 8))
def test_laws_of_assignment(matrix, mode, floor):
    scores = hand_made(*matrix, mode=mode)
    config = replace(CONFIG, mode=mode, min_cameras=floor)
    threshold = 0.05 if mode == "leave-one-out" else 0.45
    result = assign_cameras(scores, config)
    seen = scores.visible_anchors > 0
    assert result.cameras.any(axis=1).all(), "every camera serves a block"
    assert np.array_equal(result.cameras, result.reasons != NOT_ASSIGNED)
    above = (scores.scores > threshold) & (seen | (mode == "paper"))
    assert np.array_equal(result.reasons == ABOVE_THRESHOLD, above)
    for block in range(seen.shape[1]):
        mine, watching = result.cameras[:, block], seen[:, block]
        assert mine.sum() >= min(floor, watching.sum()), "the floor is met, or all that see the block are there"
        topped = result.reasons[:, block] == TOPPED_UP
        assert not (topped & ~watching).any()
        assert not topped.any() or mine.sum() <= floor
        left = watching & ~mine
        if topped.any() and left.any():
            assert scores.scores[topped, block].min() >= scores.scores[left, block].max()
    for row, block in zip(*np.nonzero(result.reasons == BEST_BLOCK), strict=True):
        best = scores.scores[row, seen[row]].max() if seen[row].any() else scores.scores[row].max()
        assert scores.scores[row, block] == best
    assert np.array_equal(assign_cameras(scores, config).reasons, result.reasons)


@pytest.mark.parametrize("mode", ["coverage", "paper"])
def test_without_its_best_block_a_camera_may_train_nothing(mode):
    scores = np.array([[0.9, 0.1], [0.3, 0.2], [0.0, 0.5]])
    given = hand_made(scores, np.ones((3, 2), int), mode=mode)
    literal = assign_cameras(given, replace(CONFIG, mode=mode, always_best=False, min_cameras=0))
    assert np.array_equal(literal.cameras, scores > 0.45)
    assert "1 of 3 training photographs train no block's core" in literal.warnings[-1]
    joined = assign_cameras(given, replace(CONFIG, mode=mode, min_cameras=0))
    assert joined.cameras.any(axis=1).all()
    assert not any("train no block" in line for line in joined.warnings)


def test_equal_scores_are_settled_by_anchors_held_and_then_by_index():
    scores = hand_made([[0.2, 0.2, 0.2]] * 4, [[1, 2, 2], [1, 1, 1], [3, 0, 0], [1, 1, 0]])
    result = assign_cameras(scores, replace(CONFIG, min_cameras=2))
    assert np.argmax(result.reasons == BEST_BLOCK, axis=1).tolist() == [1, 0, 0, 0]
    assert np.flatnonzero(result.reasons[:, 1] == TOPPED_UP).tolist() == [1]
    assert np.flatnonzero(result.reasons[:, 2] == TOPPED_UP).tolist() == [0, 1]


def test_a_camera_that_sees_nothing_joins_the_block_beneath_it():
    scores = compute_score_matrix(scene(), strips(4), [skyward()], CONFIG)
    assert scores.nadir_block.tolist() == [3]
    assert assign_cameras(scores, CONFIG).reasons.tolist() == [[0, 0, 0, BEST_BLOCK]]


def test_a_camera_over_the_ring_alone_is_not_taken_for_it():
    """It would draw anchors that do not move, and teach nothing."""
    scores = hand_made([[0.9, 0.6]], [[0, 5]])
    assert assign_cameras(scores, CONFIG).reasons.tolist() == [[NOT_ASSIGNED, ABOVE_THRESHOLD]]
    assert assign_cameras(replace(scores, mode="paper"), CONFIG).reasons.tolist() == [
        [ABOVE_THRESHOLD, ABOVE_THRESHOLD]
    ]


def test_a_block_without_cameras_complains_and_says_why():
    scores = compute_score_matrix(scene(), strips(4), [camera(2.0), camera(8.0)], CONFIG)
    lines = assign_cameras(scores, replace(CONFIG, min_cameras=5)).warnings
    assert [line.split(":")[0] for line in lines] == ["Block 2", "Block 3"]
    assert "no training camera sees any of its 225 anchors" in lines[1]
    (unpicked,) = assign_cameras(hand_made([[0.3, 0.2]]), CONFIG).warnings
    assert "1 training camera(s) see" in unpicked
    assert "best: 0.2" in unpicked
    nothing = replace(hand_made([[1.0, 0.0]]), anchors=np.array([7, 0]))
    assert "Block 1 holds no anchors" in assign_cameras(nothing, CONFIG).warnings[0]
    assert assign_cameras(hand_made([[0.3, 0.2]]), replace(CONFIG, min_cameras=1)).warnings == []


# What is kept and shown


@pytest.fixture
def saved(tmp_path):
    scores = compute_score_matrix(scene(), strips(4), [camera(2.0), camera(8.0), skyward()], CONFIG)
    result = assign_cameras(scores, CONFIG)
    path = tmp_path / "partition" / "scores.npz"
    save_scores(path, ["a.jpg", "b/ö.jpg", "c.jpg"], scores, result)
    return path, scores, result


def test_what_is_saved_is_loaded(saved):
    path, scores, result = saved
    names, loaded, decided = load_scores(path)
    assert names == ["a.jpg", "b/ö.jpg", "c.jpg"]
    assert loaded.mode == "coverage"
    for name in ("scores", "visible_anchors", "coverage", "anchors", "nadir_block"):
        assert np.array_equal(getattr(loaded, name), getattr(scores, name))
    assert np.array_equal(decided.reasons, result.reasons)
    assert np.array_equal(decided.cameras, result.cameras)
    assert decided.warnings == result.warnings
    assert len(result.warnings) == 2
    before = path.read_bytes()
    save_scores(path, names, loaded, decided)
    assert path.read_bytes() == before


def test_the_scores_of_no_camera_at_all_can_be_saved(tmp_path):
    scores = compute_score_matrix(scene(), strips(2), [], CONFIG)
    result = assign_cameras(scores, CONFIG)
    assert len(result.warnings) == 2
    save_scores(tmp_path / "none.npz", [], scores, result)
    assert load_scores(tmp_path / "none.npz").scores.scores.shape == (0, 2)


def test_missing_and_damaged_files_say_so(saved, tmp_path):
    path, scores, result = saved
    with pytest.raises(RunError, match="is not there"):
        load_scores(tmp_path / "nothing.npz")
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for cut in (0, 10, len(whole) // 2, len(whole) - 3):
        path.write_bytes(whole[:cut])
        with pytest.raises(RunError, match=r"scores\.npz: is damaged"):
            load_scores(path)
    for place in rng.integers(0, len(whole), 300):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
        try:  # a byte that nobody reads (a date, say) may change
            loaded = load_scores(path)
        except RunError:
            continue
        assert np.array_equal(loaded.scores.scores, scores.scores)
        assert np.array_equal(loaded.assignment.reasons, result.reasons)


def test_a_file_whose_arrays_disagree_is_refused(saved):
    path, _, _ = saved
    with np.load(path, allow_pickle=False) as file:
        arrays = dict(file)
    for name, value in (
        ("visible_anchors", arrays["visible_anchors"][:1]), ("reasons", arrays["reasons"] + 9),
        ("scores", arrays["scores"].astype(float)),
        ("names", np.arange(3)), ("format", np.array("other")),
    ):  # fmt: skip
        np.savez(path, **{**arrays, name: value})
        with pytest.raises(RunError, match="is damaged"):
            load_scores(path)


def test_anyone_can_ask_why(saved):
    names, scores, result = load_scores(saved[0])
    rows = explain_assignment(names, scores, result, "b/ö.jpg")
    assert [row.block for row in rows[:1]] == [1]
    assert rows[0].reason == "above the threshold"
    assert [row.score for row in rows[1:]] == sorted((row.score for row in rows[1:]), reverse=True)
    assert {row.reason for row in rows[1:]} == {"not assigned"}
    assert sorted(row.block for row in rows) == [0, 1, 2, 3]
    with pytest.raises(RunError, match="no training view 'z'"):
        explain_assignment(names, scores, result, "z")


def test_the_table_counts_what_was_decided(saved):
    _, scores, result = saved
    blocks, positions = strips(4), scene().anchors.positions.numpy()
    visibility = kernels.count_visibility(scene().anchors.positions, [camera(2.0), camera(8.0)]).numpy()
    rows = assignment_rows(blocks, positions, visibility, result)
    for index, row in enumerate(rows):
        assert row.cameras == row.above_threshold + row.best_block + row.topped_up
        assert row.cameras == result.cameras[:, index].sum()
        assert row.anchors_core == scores.anchors[index] < row.anchors_expanded
        assert row.area == pytest.approx(36.0)
    assert rows[3].mean_v == 0.0 < rows[0].mean_v
    console = Console(width=100, file=io.StringIO())
    console.print(make_assignment_table(rows))
    lines = [line.split() for line in console.file.getvalue().splitlines()]
    assert [line[:2] for line in lines if line and line[0].isdigit()] == [
        [str(row.block), str(row.cameras)] for row in rows
    ]
    assert [record_from_dict(BlockCamerasRecord, json.loads(json.dumps(record_to_dict(row)))) for row in rows] == rows
