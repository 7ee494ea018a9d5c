"""The report: whole, of unfinished and of damaged runs, and safe and small whatever the files hold."""

from __future__ import annotations

import io
import json
import re
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from support.report_page import Page
from vdgs.errors import RunError
from vdgs.report import charts
from vdgs.report.embedded_images import EmbeddedImage, load_embedded_image
from vdgs.report.run_reader import ReportedRun
from vdgs.report.scene_sections import html_export_link
from vdgs.report.write_report import link_exports, write_report
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_status import get_run_status

pytestmark = [pytest.mark.xdist_group("report"), pytest.mark.slow]

FILES = ("coarse/initialization.json",
         "coarse/log.jsonl", "coarse/evaluation/metrics.json", "visibility/visibility.json", "partition/partition.json",
         "blocks/00/log.jsonl", "blocks/01/status.json", "merged/status.json", "evaluation/metrics.json",
         "evaluation/per_view.json", "evaluation/by_block.json", "config.yaml", "capture.json")  # fmt: skip
PICTURES = ("visibility/map.png", "partition/blocks.png", "partition/block_facts.png", "partition/scores.png",
            "evaluation/contact_sheet.png")  # fmt: skip


FULL_DPI = charts.DPI


@pytest.fixture(autouse=True)
def small_charts(monkeypatch):
    """Drawing is what a report takes longest for, and few tests are about charts."""
    monkeypatch.setattr(charts, "DPI", 40)


@pytest.fixture
def blank_charts(monkeypatch):
    """For what is not about charts: they are laid out, not drawn."""
    monkeypatch.setattr(charts, "_to_image", lambda figure: EmbeddedImage(b"", *figure.canvas.get_width_height()))


@cache
def png(noise: bool) -> bytes:
    """A large picture of noise, or a small one of one color."""
    pixels = np.random.default_rng(0).integers(0, 256, (700, 1000, 3), dtype=np.uint8) if noise else None
    content = io.BytesIO()
    image = Image.new("RGB", (60, 40), "teal") if pixels is None else Image.fromarray(pixels)
    image.save(content, "PNG", compress_level=1)
    return content.getvalue()


def picture(path: Path, noise: bool = False) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(png(noise))


def write(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")


def metrics(psnr: float, model: str) -> dict[str, object]:
    bins = [
        {"lower": low, "upper": high, "pixels": 1234, "psnr": psnr + shift, "ssim": 0.8, "psnr_cc": psnr + 1}
        for low, high, shift in ((None, None, -9.0), (1.0, 3.0, -2.0), (4.0, 9.0, 2.0))
    ]
    return {"model": model, "psnr": psnr, "ssim": 0.87654, "psnr_cc": psnr + 0.5, "ssim_cc": 0.88, "lpips_vgg": None,
            "by_visibility": bins, "n_anchors": 5000, "model_bytes": 2_000_000, "fps": 30.0, "test_views": 3,
            "notes": ["LPIPS is null: no weights."]}  # fmt: skip


def log(iterations: int, cycles: bool = False) -> str:
    lines = []
    for at in range(50, iterations + 1, 50):
        line = {"iteration": at, "loss": 1 / at, "psnr_smoothed": 20 + at / 100, "anchors": 1000 + at, "downscale": 1}
        if cycles and at % 100 == 0:
            line |= {"low_share": 0.4, "t_low": 0.2, "mean_cache": 1e-4, "grown_low": 30, "grown_other": 10}
        lines.append(json.dumps(line))
    return "\n".join(lines) + "\n"


def coarse_run(root: Path, name: str = "meadow") -> RunFolder:
    """A run whose coarse model is trained and evaluated."""
    header = {"vdgs": {"version": "0.1.0", "commit": "0123456789abcdef"}, "capture": {"path": f"/some/where/{name}"}}
    write(root / "config.yaml", json.dumps(header) + "\n")  # JSON is YAML
    write(root / "capture.json", {"training_views": ["a"] * 7, "test_views": ["b"] * 3, "warnings": []})
    status = {"state": "done", "iteration": 400, "iterations": 400, "anchors": 1400, "seconds": 83.0,
              "peak_memory_bytes": 500_000_000, "psnr_training": 24.0}  # fmt: skip
    write(root / "coarse/status.json", status)
    start = {"sparse_points": 2000, "dense_points": 12_757, "brightness_differs": 0.029, "exposures": True}
    write(root / "coarse/initialization.json", start)
    write(root / "coarse/log.jsonl", log(400))
    write(root / "coarse/evaluation/metrics.json", metrics(27.125, "coarse"))
    write(root / "coarse/evaluation/per_view.json", views(27.0))
    return RunFolder(root)


def views(psnr: float, names: tuple[str, ...] = ("first.jpg", "second.jpg", "third.jpg")) -> list[dict[str, object]]:
    return [
        {"name": name, "render": f"renders/{name[:-4]}.png", "psnr": psnr + index, "ssim": 0.9, "psnr_cc": psnr + 1,
         "mean_visibility": 4.0 + index}
        for index, name in enumerate(names)
    ]  # fmt: skip


def whole_run(root: Path, name: str = "meadow", noise: bool = False) -> RunFolder:
    """A run with all stages, by hand."""
    run = coarse_run(root, name)
    write(
        root / "visibility/visibility.json",
        {
            "anchors": 1400,
            "training_views": 7,
            "mean": 4.5,
            "gini": 0.25,
            "quantiles": {"5": 1, "50": 4},
            "fraction_below": {"3": 0.125},
        },
    )
    rows = [
        {
            "block": b,
            "cameras": 5 + b,
            "above_threshold": 3,
            "best_block": 1,
            "topped_up": 1 + b,
            "anchors_core": 700,
            "anchors_expanded": 900,
            "mean_v": 4.5,
            "area": 321.0,
        }
        for b in (0, 1)
    ]
    spatial = [{"block": 0, "anchors_core": 650, "area": 300.0, "mean_v": 4.0, "std_v": 1.75}]
    write(
        root / "partition/partition.json",
        {
            "lambda_vis": 1.0,
            "blocks": rows,
            "spatial_only_blocks": spatial,
            "seconds": 4.5,
            "warnings": ["Block 1 is thin."],
            "assignment_warnings": ["Block 0 is blind."],
        },
    )
    for block in (0, 1):
        write(root / f"blocks/{block:02d}/log.jsonl", log(300, cycles=True))
        write(
            root / f"blocks/{block:02d}/status.json",
            {"state": "done", "iteration": 300, "iterations": 300, "seconds": 61.0, "peak_memory_bytes": 1_500_000_000},
        )
    write(root / "merged/status.json", {"state": "done", "merge_seconds": 0.5, "merge_peak_memory_bytes": 4e8})
    write(root / "evaluation/metrics.json", metrics(28.375, "merged"))
    write(root / "evaluation/per_view.json", views(28.0))
    write(root / "evaluation/status.json", {"seconds": 3.5, "peak_memory_bytes": 6e8})
    figures = {"pixels": 99, "psnr_coarse": 27.0, "psnr_isolated": 27.5, "psnr_merged": 27.75}
    write(root / "evaluation/by_block.json", {
        "blocks": [{"block": 0, **figures}, {"block": 1, **figures}], "all": figures,
        "seams": {"border_px": 10.0, "border_pixels": 77, "seam_mae_ratio": 1.0625, "seam_mse_ratio": 1.125},
        "views": [{"name": "first.jpg", "border_pixels": 40}]})  # fmt: skip
    names = [f"evaluation/comparisons/{name}.png" for name in ("first", "second", "third")]
    for file in (*PICTURES, *names, "evaluation/seams/first.png"):
        picture(root / file, noise)
    return run


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Page:
    """The report of a run with all stages."""
    run = whole_run(tmp_path_factory.mktemp("whole") / "run")
    path = write_report(run)
    assert path == run.path / "report.html"
    return Page(path)


def test_the_report_of_a_whole_run_holds_its_figures(whole):
    page = whole
    assert page.row("PSNR (dB) ↑") == ["PSNR (dB) ↑", "27.12", "28.38", "+1.25"]
    assert page.row("PSNR, color-corrected (dB) ↑")[1:] == ["27.62", "28.88", "+1.25"]
    assert page.row("SSIM ↑")[1:] == ["0.8765", "0.8765", "+0.0000"]
    assert page.row("1 to 3")[1:5] == ["1,234", "25.12", "26.38", "+1.25"]
    assert page.row("nothing drawn")[2:4] == ["18.12", "19.38"]
    assert page.row("all") == ["all", "11", "6", "2", "3"]  # cameras: in all, and by reason
    assert page.row("block 0")[1:4] == ["300 / 300", "–", "–"]
    assert page.row("partition and assignment")[1] == "4.5 s"
    assert page.row("sum, highest")[1:3] == ["3 min 34 s", "1.50 GB"]
    text = page.text()
    for words in ("meadow", "commit 0123456789ab", "7 training and 3 test photographs", "Block 1 is thin.",
                  "Block 0 is blind.", "PSNR 27.12 → 28.38 dB (+1.25)", "12.5 % of the anchors by fewer than 3",
                  "1.06 times", "Best: third.jpg, 30.00 dB", "Median: second.jpg", "Worst: first.jpg",
                  "LPIPS is null: no weights."):  # fmt: skip
        assert words in text, words
    assert 'class="absent"' not in page.source
    # Five figures, three comparisons, a seam, and charts: 3 + 3 of training, 3 of growth, 2 by visibility.
    assert page.tags.count("img") == 5 + 3 + 1 + 11


def linked_page(run: RunFolder, *files: dict[str, object]) -> str:
    """What the report leads to where these files were exported; "" where it leads to none."""
    write(run.path / "export.json", {"files": files})
    return html_export_link(ReportedRun(run, get_run_status(run)))


def test_the_report_leads_to_a_page_of_the_scene_that_it_shows(tmp_path):
    run = coarse_run(tmp_path / "run")
    page = tmp_path / "my place&co.html"
    page.write_bytes(b"<html></html>")
    write(run.path / "merged/status.json", {"state": "done", "model_id": "9-whole"})
    file = {"file": str(page), "bytes": 13, "model_id": "9-whole", "block": None, "bbox": None, "min_visibility": 0}
    link = linked_page(run, {**file, "file": "export/scene.ply"}, file)
    assert '<a href="../my%20place%26co.html">Move through the scene</a>' in link
    assert "my place&amp;co.html, 0.0 MB; opens offline)" in link
    assert "without what fewer than 3 photographs show)" in linked_page(run, {**file, "min_visibility": 3})
    for other in ({"model_id": "8-of-one-block"}, {"model_id": None}, {"block": 0}, {"bbox": [0, 0, 1, 1]},
                  {"bytes": 14}, {"file": str(page.with_suffix(".ply"))}):  # fmt: skip
        assert not linked_page(run, {**file, **other}), other
    assert not linked_page(run)
    # A page in the run is there wherever the run is moved.
    page.rename(run.path / "scene.html")
    run.path.rename(tmp_path / "moved")
    moved = RunFolder(tmp_path / "moved")
    assert '<a href="scene.html">Move through the scene</a>' in linked_page(moved, {**file, "file": "scene.html"})
    assert not linked_page(moved, file)
    write(moved.path / "export.json", {"files": 3})
    assert not html_export_link(ReportedRun(moved, get_run_status(moved)))


def test_a_page_of_the_coarse_model_is_one_of_the_scene_until_there_is_a_merged_one(tmp_path):
    run = coarse_run(tmp_path)
    write(tmp_path / "coarse/status.json", {"state": "done", "model_id": "9-coarse"})
    write(tmp_path / "scene.html", "<html></html>")
    file = {"file": "scene.html", "bytes": 13, "model_id": "9-coarse"}
    assert linked_page(run, file)
    for state, is_linked in (("running", True), ("done", False)):
        write(tmp_path / "merged/status.json", {"state": state, "model_id": "9-whole"})
        assert bool(linked_page(run, file)) is is_linked


@pytest.mark.usefixtures("blank_charts")
def test_a_report_that_may_only_be_read_is_no_error_of_an_export(tmp_path):
    run, said = coarse_run(tmp_path / "run"), Console(record=True, width=300, file=io.StringIO())
    (run.path / "report.html").mkdir()  # stands for a folder that cannot be written, which root can
    link_exports(run, said)
    assert said.export_text() == f"note {run.path}/report.html cannot be written: it will not link to the page\n"


@pytest.mark.usefixtures("blank_charts")
def test_the_least_solid_view_is_shown_and_solidity_compared(tmp_path):
    run = whole_run(tmp_path)
    known = metrics(28.375, "merged") | {
        "opacity_coverage": 0.8765,
        "psnr_covered_black": 27.5,
        "oversized_splats": 12,
    }
    write(tmp_path / "evaluation/metrics.json", known)
    rows = views(28.0)
    for row, share in zip(rows, (0.9, 0.25, 0.8), strict=True):
        row |= {
            "opacity_coverage": share,
            "alpha": str(row["render"]).replace("renders", "alpha"),
            "oversized_splats": 4,
        }
        picture(tmp_path / "evaluation" / str(row["alpha"]))
    write(tmp_path / "evaluation/per_view.json", rows)
    page = Page(write_report(run))
    assert page.row("share of seen pixels that is opaque ↑") == [
        "share of seen pixels that is opaque ↑",
        "–",
        "0.8765",
        "–",
    ]
    assert page.row("second.jpg")[-2:] == ["25.0 %", "4"]
    assert "Least solid: alpha of second.jpg" in page.text()
    assert "25.0 % have alpha" in page.text()


@pytest.mark.usefixtures("blank_charts")
def test_views_from_where_nobody_flew_are_shown_of_the_model_that_is_reported(tmp_path):
    run = coarse_run(tmp_path)
    figures = {"views": 3, "psnr": 21.5, "depth_within_2_percent_median": 0.75, "needles": 0.05, "floaters": None}
    angles = [{"lower": 40.0, "upper": None, "pixels": 90, "psnr": 19.25, "depth_within_2_percent": 0.5}]
    known = metrics(20.0, "coarse") | {"sets": {"street": figures}, "by_angle": angles}
    write(tmp_path / "coarse/evaluation_off_path/metrics.json", known)
    page = Page(write_report(run))
    assert page.row("street") == ["street", "3", "21.50", "–", "75.0 %", "–", "5.0 %", "–", "–", "–"]
    assert page.row("above 40°") == ["above 40°", "90", "19.25", "50.0 %"]
    write(tmp_path / "coarse/evaluation_off_path/metrics.json", known | {"key": "of another model"})
    assert "Off the path" not in Page(write_report(run)).source


def test_growth_is_summed_for_each_block(whole):
    table = whole.source[whole.source.index("Sums over all cycles") :]
    assert re.findall(r"<td>(.*?)</td>", table)[:6] == ["block 0", "3", "90", "30", "75.0 %", "40.0 %"]


@pytest.mark.usefixtures("blank_charts")
def test_a_coarse_run_is_reported_with_what_it_has(tmp_path):
    page = Page(write_report(coarse_run(tmp_path / "run")))
    text = page.text()
    assert "Coarse model: PSNR 27.12 dB (color-corrected 27.62), SSIM 0.8765." in text
    assert "The scene is not cut into blocks yet." in text
    assert "No block has a log yet." in text
    assert page.row("PSNR (dB) ↑") == ["PSNR (dB) ↑", "27.12", "–", "–"]
    assert page.row("1 to 3")[2:5] == ["25.12", "–", "–"]
    assert "Best: third.jpg, 29.00 dB" in text
    assert page.source.count('class="note"') == 1  # its config.yaml is not whole
    assert "It cannot be told whether these were made with the settings of the run: coarse, coarse eval" in text


@pytest.mark.usefixtures("blank_charts")
def test_the_coarse_model_may_be_the_one_that_is_evaluated(tmp_path):
    run = coarse_run(tmp_path / "run")
    shutil.move(run.path / "coarse/evaluation", run.path / "evaluation")
    page = Page(write_report(run))
    assert page.row("PSNR (dB) ↑") == ["PSNR (dB) ↑", "27.12", "–", "–"]
    assert "Coarse model: PSNR 27.12" in page.text()


@pytest.mark.usefixtures("blank_charts")
def test_an_empty_folder_gives_a_report_and_none_an_error(tmp_path):
    text = Page(write_report(RunFolder(tmp_path))).text()
    assert "Nothing is evaluated yet." in text
    with pytest.raises(RunError, match="not a run folder"):
        write_report(RunFolder(tmp_path / "nowhere"))


@pytest.mark.usefixtures("blank_charts")
def test_the_report_tells_what_training_began_with(tmp_path):
    run = coarse_run(tmp_path / "run")
    text = Page(write_report(run)).text()
    assert "starts from 2,000 sparse points and 12,757 that stereo found" in text
    assert "differ in brightness by 2.9 %. Each has an exposure" in text
    alike = {"sparse_points": 90, "dense_points": None, "brightness_differs": 0.004, "exposures": False}
    write(run.path / "coarse/initialization.json", alike)
    text = Page(write_report(run)).text()
    assert "starts from 90 sparse points." in text
    assert "differ in brightness by 0.4 %. None has an exposure" in text
    (run.path / "coarse/initialization.json").unlink()  # of a version before
    assert "It starts from" not in Page(write_report(run)).text()


@pytest.mark.parametrize(
    "damage",
    ["[[1, {", '{"blocks": 3}', "\x00\xff" + "[" * 100_000],
    ids=["cut off", "of another kind", "nested deeply"],
)
def test_damaged_files_are_named_and_the_rest_stands(tmp_path, damage):
    run = whole_run(tmp_path / "run")
    for file in FILES:
        (run.path / file).write_text(damage, encoding="latin-1")
    text = Page(write_report(run)).text()
    assert "block 0" in text
    if damage != '{"blocks": 3}':  # that is valid, and says nothing
        for file in FILES:
            if file != "config.yaml":
                assert file in text, file


@pytest.mark.usefixtures("blank_charts")
def test_one_damaged_file_leaves_the_other_sections_alone(tmp_path):
    run = whole_run(tmp_path / "run")
    (run.path / "evaluation/per_view.json").write_text("[{")
    (run.path / "visibility/map.png").write_bytes((run.path / "visibility/map.png").read_bytes()[:60])
    with (run.path / "coarse/log.jsonl").open("a") as file:
        file.write('{"iteration": 45')
    page = Page(write_report(run))
    notes = re.findall(r'<p class="note">(.*?)</p>', page.source)
    assert any(note.startswith("evaluation/per_view.json is damaged") for note in notes)
    assert any(note.startswith("visibility/map.png is damaged") for note in notes)
    assert "coarse/log.jsonl: 1 line could not be read and is left out." in notes
    assert page.row("PSNR (dB) ↑")[2] == "28.38"


@pytest.mark.parametrize("value", ["x", -1, 10**400], ids=["text", "negative", "endless"])
def test_values_of_any_kind_are_survived(tmp_path, value):
    run = whole_run(tmp_path / "run")
    for file in FILES:
        path = run.path / file
        if path.suffix == ".json":
            write(path, _replaced(json.loads(path.read_text()), value))
    report = write_report(run)
    Page(report)  # refuses tags that do not balance
    assert report.read_text(encoding="utf-8").rstrip().endswith("</html>")


def _replaced(content, value):
    """Every number and text of a JSON value replaced."""
    if isinstance(content, dict):
        return {key: _replaced(each, value) for key, each in content.items()}
    if isinstance(content, list):
        return [_replaced(each, value) for each in content]
    return value


@pytest.mark.usefixtures("blank_charts")
def test_hostile_names_stay_text(tmp_path):
    evil = "<script>alert('x')</script>\"&<img src=https://e.example/x.png>\x00\ud800"
    run = whole_run(tmp_path / "run", name=evil.replace("/", "|"))
    write(run.path / "evaluation/per_view.json", views(28.0, names=(evil + "1", "../../../x.jpg", "n" * 900)))
    write(run.path / "evaluation/by_block.json", {"views": [{"name": evil, "border_pixels": 3}]})
    write(run.path / "partition/partition.json", {"warnings": [evil], "blocks": [{"block": evil}]})
    write(run.path / "blocks/00/status.json", {"state": "failed", "reason": evil})
    page = Page(write_report(run))
    assert "script" not in page.tags
    assert "alert('x')" in page.text()
    assert page.row("block 0")[-1].startswith("failed: &lt;script&gt;")
    assert not re.search("[\x00-\x08\x0b-\x1f]", page.source)


def test_nothing_is_loaded_from_elsewhere(whole):
    page = whole
    assert {"script", "link", "iframe", "object", "base"}.isdisjoint(page.tags)
    for tag, name, value in page.attributes:
        assert not name.startswith("on")
        if name in ("src", "href", "srcset", "action"):
            assert value.startswith("data:image/" if tag == "img" else "#"), value
    ids = {value for _, name, value in page.attributes if name == "id"}
    assert {value[1:] for _, name, value in page.attributes if name == "href"} == ids
    assert "url(" not in page.source
    assert "@import" not in page.source


def test_the_report_stays_small_with_many_views_and_large_pictures(tmp_path, monkeypatch):
    monkeypatch.setattr(charts, "DPI", FULL_DPI)
    reduced = dict[bytes, EmbeddedImage]()  # all large pictures are the same: one is reduced, each is embedded

    def load_once(path: Path) -> EmbeddedImage:
        content = path.read_bytes()
        if content not in reduced:
            reduced[content] = load_embedded_image(path)
        return reduced[content]

    monkeypatch.setattr("vdgs.report.run_reader.load_embedded_image", load_once)
    run = whole_run(tmp_path / "run", noise=True)
    names = tuple(f"{index:03d}.jpg" for index in range(150))
    write(run.path / "evaluation/per_view.json", views(20.0, names))
    write(run.path / "evaluation/by_block.json", {"views": [{"name": n, "border_pixels": 9} for n in names]})
    for name in ("000", "074", "149"):
        shutil.copy(run.path / PICTURES[0], run.path / f"evaluation/comparisons/{name}.png")
    for name in names[:6]:
        shutil.copy(run.path / PICTURES[0], run.path / f"evaluation/seams/{name[:-4]}.png")
    path = write_report(run)
    page = Page(path)
    assert path.stat().st_size < 8_000_000
    assert page.row("149.jpg")[3] == "169.00"
    assert sum(value.startswith("seams in") for _, name, value in page.attributes if name == "alt") == 3
