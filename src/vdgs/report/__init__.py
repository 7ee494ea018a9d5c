"""The report of a run: one HTML file with figures, metrics, pictures and settings, which opens anywhere."""

from __future__ import annotations

from pathlib import Path

from vdgs.files import write_text
from vdgs.report import page, sections
from vdgs.run import RunFolder


def write_report(run: RunFolder) -> Path:
    """Write RUN/report.html from the files of the run folder; what is not there yet, or damaged, is said in it.

    Raises RunError if the folder is no run, VdgsError if the disk refuses.
    """
    run.settings()  # a folder that is no run has nothing to report
    models = sections.Models(run)
    parts = (
        ("visibility", "The place and its visibility", sections.visibility(run)),
        ("blocks", "Blocks", sections.blocks(run)),
        ("cameras", "Cameras of the blocks", sections.assignment(run)),
        ("training", "Training", sections.training(run)),
        ("views", "Test views", sections.test_views(models)),
        ("quality", "Quality", sections.quality(models)),
        ("seams", "Blocks and seams", sections.seams(run)),
        ("costs", "Time and memory", sections.costs(run)),
        ("settings", "Settings", sections.settings(run)),
    )
    links = "".join(f'<a href="#{anchor}">{page.escape(title)}</a>' for anchor, title, _ in parts)
    body = [*sections.header(run, models), f"<nav>{links}</nav>"]
    body += [page.section(anchor, title, content) for anchor, title, content in parts]
    path = run.path / "report.html"
    write_text(path, page.document(f"vdgs: {run.path.name}", body))
    return path
