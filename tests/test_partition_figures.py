"""The figures of a partition are drawn for any number of blocks, cameras and anchors."""

import cv2
import numpy as np
import pytest
import shapely

from captures_support import look_down
from vdgs.cameras import Camera
from vdgs.partition import figures
from vdgs.partition.blocks import Block, Blocks
from vdgs.partition.figure_words import block_colour


def columns(count: int, width: float = 10.0) -> Blocks:
    """Strips beside each other."""
    cores = [shapely.box(i * width, 0, (i + 1) * width, 30) for i in range(count)]
    return Blocks(tuple(Block(core, core.buffer(3)) for core in cores))


def scene(anchors: int, cameras: int, blocks: int):
    generator = np.random.default_rng(0)
    positions = generator.uniform([0, 0, 0], [10 * blocks, 30, 2], (anchors, 3)).astype(np.float32)
    views = generator.poisson(6, anchors)
    poses = [look_down(np.array([*place, 20.0])) for place in generator.uniform(0, [10 * blocks, 30], (cameras, 2))]
    return positions, views, [Camera(pose, 50, 50, 32, 24, 64, 48) for pose in poses]


@pytest.mark.parametrize(("anchors", "cameras", "blocks"), [(500, 8, 1), (3000, 40, 16), (50, 0, 2), (1, 1, 1)])
def test_all_figures_are_drawn(tmp_path, anchors, cameras, blocks):
    positions, views, flown = scene(anchors, cameras, blocks)
    cut = columns(blocks)
    assigned = np.random.default_rng(1).random((cameras, blocks)) > 0.5
    compare = columns(blocks) if blocks > 1 else None
    figures.draw_visibility_map(tmp_path / "map.png", positions, views, flown, "m")
    figures.draw_blocks(tmp_path / "blocks.png", positions, views, cut, flown, assigned, "m", compare, 1.0)
    figures.draw_block_facts(tmp_path / "facts.png", positions, views, cut, assigned, "m", compare)
    figures.draw_scores(tmp_path / "scores.png", assigned.astype(np.float32), assigned)
    for path in tmp_path.glob("*.png"):
        picture = cv2.imread(str(path))
        assert min(picture.shape[:2]) > 200
        assert max(picture.shape[:2]) < 6000, path.name
        assert picture.std() > 5, path.name
    assert len(list(tmp_path.glob("*.png"))) == 4


def test_the_score_matrix_of_thousands_of_cameras_stays_legible(tmp_path):
    scores = np.random.default_rng(0).random((3000, 8)).astype(np.float32)
    figures.draw_scores(tmp_path / "scores.png", scores, scores > 0.8)
    picture = cv2.imread(str(tmp_path / "scores.png"))
    assert 600 < picture.shape[0] < 3000


def test_neighbouring_blocks_have_other_colours():
    colours = [block_colour(index) for index in range(16)]
    assert len({str(colour) for colour in colours}) == 16
