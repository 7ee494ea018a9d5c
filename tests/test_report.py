"""The report of a run: complete, in one file, and undisturbed by what is missing, damaged or hostile."""

import json
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vdgs.config import PRESETS, to_dict
from vdgs.errors import RunError
from vdgs.report import write_report
from vdgs.run import RunFolder

HOSTILE = "<script>alert(1)</script>&.jpg"
VOID = {"meta", "img", "br", "link"}


class Balance(HTMLParser):
    """Every tag that opens closes; what it names is collected."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.links: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def read(path: Path) -> Balance:
    page = Balance()
    page.feed(path.read_text(encoding="utf-8"))
    assert page.open == []
    assert "script" not in page.tags
    assert all(link.startswith(("data:image/", "#")) for link in page.links)
    return page


def put(path: Path, value) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(value, tuple):
        noise = np.random.default_rng(0).integers(0, 255, (value[1], value[0], 3), np.uint8)
        Image.fromarray(noise).save(path)
    else:
        path.write_text(value if isinstance(value, str) else json.dumps(value))


def metrics(model: str, psnr: float) -> dict:
    bins = [{"lower": lower, "upper": lower + 1.0, "pixels": 100, "psnr": psnr + lower, "ssim": 0.8, "psnr_cc": psnr}
            for lower in (0.0, 2.0)]  # fmt: skip
    return {"model": model, "psnr": psnr, "psnr_cc": psnr + 1, "ssim": 0.81234, "ssim_cc": None, "lpips_vgg": None,
            "by_visibility": bins, "n_anchors": 4321, "notes": ["LPIPS is null"], "test_views": 3}  # fmt: skip


def coarse_only(folder: Path) -> RunFolder:
    run = RunFolder(folder / "run")
    run.begin({"capture": {"path": "/place"}} | to_dict(PRESETS["laptop"]))
    put(run.capture_file, {"root": f"/data/{HOSTILE}", "images": "images_4", "training_views": ["a"], "test_views": []})
    lines = [{"iteration": i, "psnr_smoothed": 20 + i / 100, "loss": 0.1, "anchors": 100 + i} for i in (50, 100, 150)]
    put(run.coarse.log, "\n".join(json.dumps(line) for line in lines) + '\n{"broken')
    put(
        run.coarse.status_file, {"state": "done", "iteration": 150, "seconds": 3700, "peak_memory_bytes": 2_000_000_000}
    )
    put(run.evaluation / "metrics.json", metrics("coarse", 25.25))
    put(
        run.evaluation / "per_view.json",
        [{"name": HOSTILE, "render": "renders/x.png", "psnr": p} for p in (20, 25, 30)],
    )
    put(run.evaluation / "contact_sheet.png", (900, 600))
    return run


def complete(folder: Path) -> RunFolder:
    run = coarse_only(folder)
    put(run.coarse.path / "evaluation/metrics.json", metrics("coarse", 25.25))
    put(run.evaluation / "metrics.json", metrics("merged", 26.5))
    put(run.evaluation / "comparisons/x.png", (1200, 300))
    put(run.evaluation / "seams/a.png", (1200, 300))
    put(run.evaluation / "by_block.json", {"blocks": [{"block": 0, "pixels": 9, "psnr_merged": 31.75}],
                                           "seams": {"mae_merged": {"ratio": 0.987}}})  # fmt: skip
    put(run.visibility / "visibility.json", {"quantiles": {"5": 1.0, "95": 9.0}, "gini": 0.123})
    for name in ("blocks.png", "block_facts.png", "scores.png"):
        put(run.partition / name, (800, 500))
    put(run.visibility / "map.png", (800, 500))
    put(run.partition / "partition.json", {"blocks": [{"block": 0, "cameras": 77, "area": 1234.0, "mean_v": 4.5}],
                                           "warnings": ["only <one> block"], "complaints": []})  # fmt: skip
    cycle = {"low_share": 0.25, "mean_cache": 1e-4, "grown_low": 5, "grown_other": 2}
    put(run.block(0).log, "\n".join(json.dumps({"iteration": i, "anchors": 9} | cycle) for i in (100, 200)))
    put(run.block(0).status_file, {"state": "failed", "iteration": 200, "seconds": 12.3})
    return run


def test_a_complete_run_shows_its_numbers(tmp_path):
    path = write_report(complete(tmp_path))
    page = read(path)
    text = " ".join(page.text)
    shown = ["26.50", "+1.25 dB", "0.8123", "4,321", "31.75", "0.987", "0.12", "77", "1:01:40 h", "2.00 GB",
             "only <one> block", "block 0 (failed)", "LPIPS is null", "t_low_quantile"]  # fmt: skip
    assert [figure for figure in shown if figure not in text] == []
    assert page.tags.count("img") == 12
    assert path.stat().st_size < 8_000_000


def test_a_run_without_blocks_says_what_is_not_there_yet(tmp_path):
    page = read(write_report(coarse_only(tmp_path)))
    text = " ".join(page.text)
    assert "25.25" in text
    assert "not there yet" in text
    assert f"/data/{HOSTILE}".rsplit("/", 1)[-1] in text  # as text, never as a tag


@pytest.mark.parametrize("damage", [b"", b"{", b"[1, 2", b'{"blocks": 7}', b'"text"', b"\xff\xfe\x00"])
def test_damaged_files_do_not_stop_the_report(tmp_path, damage):
    run = complete(tmp_path)
    for path in run.path.rglob("*"):
        if path.is_file() and path.name not in ("config.yaml", ".lock"):
            path.write_bytes(damage)
    read(write_report(run))


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(RunError, match="not a run folder"):
        write_report(RunFolder(tmp_path))
