"""A film of `vdgs render` in a real browser."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed (pip install 'vdgs[viewer]')")

from support.commands import wait_until
from support.viewer import browser, open_page, served
from vdgs.rendering.video import VideoWriter, default_encoder

pytestmark = [pytest.mark.browser, pytest.mark.xdist_group("viewer")]

PAGE = """<video id="film" muted></video><script>const film = document.getElementById("film");
film.onerror = () => { document.title = "failed: " + film.error.message; };
film.onloadeddata = () => { document.title = film.videoWidth + "x" + film.videoHeight; };
film.src = "film.mp4";</script>"""


@pytest.mark.skipif(browser() is None, reason="no Chromium on this machine (apt-get install chromium)")
@pytest.mark.skipif(default_encoder() == "mpeg4", reason="nothing here encodes what browsers play")
def test_the_usual_film_plays_in_a_browser(tmp_path):
    with VideoWriter(tmp_path / "film.mp4", 10.0) as film:
        for level in range(0, 200, 20):
            film.write(np.full((64, 96, 3), level, np.uint8))
    (tmp_path / "index.html").write_text(PAGE)
    with served(tmp_path) as address, open_page(address, 200, 200) as page:
        wait_until(lambda: page.evaluate("document.title"))
        assert page.evaluate("document.title") == "96x64"
