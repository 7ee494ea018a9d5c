"""Small things that reports are made of."""

from __future__ import annotations

import numpy as np
from PIL import Image

from vdgs.report.charts import running_median
from vdgs.report.embedded_images import MAX_BYTES, reduce_image
from vdgs.report.html_page import escape_html
from vdgs.report.run_reader import format_difference


def test_a_picture_keeps_its_shape_and_stands_on_white():
    wide = reduce_image(Image.new("RGBA", (4000, 1000), (0, 0, 0, 0)))
    assert (wide.width, wide.height, wide.format) == (1600, 400, "png")
    noise = Image.fromarray(np.random.default_rng(1).integers(0, 256, (900, 900, 3), dtype=np.uint8))
    small = reduce_image(noise)
    assert small.format == "jpeg"
    assert len(small.content) <= MAX_BYTES


def test_running_medians_pass_over_gaps():
    values = np.array([1.0, 9.0, 2.0, np.nan, 4.0])
    np.testing.assert_allclose(running_median(values, 3), [5.0, 2.0, 5.5, 3.0, 4.0])


def test_words():
    assert [format_difference(1.0, before) for before in (1.25, 1.001, None)] == ["−0.25", "+0.00", "–"]
    assert escape_html("<a>&\"'\x01") == "&lt;a&gt;&amp;&quot;&#x27;\N{REPLACEMENT CHARACTER}"
