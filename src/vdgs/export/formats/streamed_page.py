"""`FOLDER/scene.json`: a folder that any web server serves, with a page that loads what is near finely.

`index.html` is the page, without anything from elsewhere; `scene.json` holds the view and a quadtree
(`tile_quadtree`), whose nodes lie in a folder beside it as the page's texture holds them: 32 bytes for each Gaussian,
as in `.html`, with V in the number that is free there. Colors do not change with the direction.
"""

from __future__ import annotations

import re
from pathlib import Path

from vdgs.captures.first_view import FOV_DEG
from vdgs.errors import VdgsError
from vdgs.export.formats.export_scene import ExportScene
from vdgs.export.formats.file_folders import FileFolder, check_no_folder
from vdgs.export.formats.gaussian_store import write_store
from vdgs.export.formats.html import PAGE_LOSSES, default_page_view, length_factor, packed_rows
from vdgs.export.formats.tile_quadtree import build_tile_quadtree
from vdgs.export.formats.tiles_3d import named_tiles
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import TEMPORARY_ENDING, write_bytes
from vdgs.system.documents import JsonObject

SCENE_FILE, PAGE_FILE = "scene.json", "index.html"
#: Gaussians of a node: a megabyte, and a slot of the page's texture.
MAX_NODE_SIZE = 1 << 15
#: What `index.html` is.
_PAGE = Path(__file__).with_name("streamed_page.html")
#: By which pages of ours are known.
_OURS = '<meta name="generator" content="vdgs">'
#: Lengths are chosen by so many Gaussians.
_SAMPLE = 1 << 17
NODE_FOLDER = FileFolder("nodes", re.compile(r"[0-3]+\.bin|\.[0-3]+\.bin" + TEMPORARY_ENDING), named_tiles)


def check_page_folder(path: Path, scene: ExportScene) -> None:
    """Raise VdgsError where the folder has another's page."""
    check_no_folder(path, "Pages that stream")
    page = path.with_name(PAGE_FILE)
    try:
        foreign = page.exists() and _OURS not in page.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise VdgsError(f"{page}: cannot be read ({error.strerror or error}). Choose another folder.") from error
    if foreign:
        raise VdgsError(f"{page}: is a page of something else. Choose another folder.")


def write_streamed_page(path: Path, scene: ExportScene, node_size: int = MAX_NODE_SIZE) -> tuple[str, ...]:
    """Write nodes and the page beside `path` and then, atomically, the document that names them; the nodes of an
    earlier one are removed last. Returns what was lost. Raises VdgsError."""
    check_page_folder(path, scene)

    def fill(folder: Path, scratch: Path) -> JsonObject:
        store = write_store(scene, scratch / "rows")
        sample = store.sample(_SAMPLE)
        factor, page = length_factor(sample), scene.page or default_page_view(sample)

        def write_node(gaussians: Gaussians, name: str) -> str:
            rows = packed_rows(gaussians, factor)
            if page.count_visibility is not None:
                rows[:, 3] = page.count_visibility(gaussians.means).numpy()
            write_bytes(folder / f"{name}.bin", rows.tobytes())
            return f"{folder.name}/{name}.bin"

        root = build_tile_quadtree(store, write_node, node_size)
        write_bytes(path.with_name(PAGE_FILE), _PAGE.read_bytes())
        facts = {**scene.metadata.to_dict(), "axes": "z up"}
        view = {"position": page.position, "target": page.target, "fov_deg": FOV_DEG, "background": page.background,
                "title": page.title, "visibility": page.count_visibility is not None}  # fmt: skip
        return {
            "asset": {"version": 1, "generator": scene.metadata.program, "extras": facts}, "gaussians": scene.count,
            "factor": factor, "view": view, "root": root.entry,
        }  # fmt: skip

    NODE_FOLDER.write(path, fill)
    return PAGE_LOSSES
