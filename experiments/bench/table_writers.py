"""Result tables as Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence

from experiments.bench.result_tables import ResultTable, TableCell

_LATEX = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "$": r"\$",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "±": r"$\pm$", "×": r"$\times$", "≥": r"$\geq$", "≤": r"$\leq$", "−": r"$-$", "–": "--", "↑": r"$\uparrow$",
    "↓": r"$\downarrow$", "λ": r"$\lambda$", "β": r"$\beta$", "γ": r"$\gamma$",
}  # fmt: skip
#: Symbols of the paper with a subscript.
_SYMBOLS = {
    "λ_vis": r"$\lambda_{\mathrm{vis}}$", "T_low": r"$T_{\mathrm{low}}$", "β_g": r"$\beta_g$",
}  # fmt: skip


def escape_markdown(text: str) -> str:
    """Plain text for a cell or a paragraph: nothing in it is markup, and a bar does not end the cell."""
    return re.sub(r"([\\`*_{}\[\]<>|#])", r"\\\1", text.replace("\n", " "))


def escape_latex(text: str) -> str:
    """Plain text for LaTeX; the paper's symbols become mathematics."""
    parts = re.split("(" + "|".join(_SYMBOLS) + ")", text.replace("\n", " "))
    return "".join(_SYMBOLS.get(part) or "".join(_LATEX.get(letter, letter) for letter in part) for part in parts)


def format_cell(cell: TableCell) -> str:
    """`24.03 ± 0.05`; the dash stands for unknown."""
    if cell.summary is None:
        return "–"
    text = f"{cell.summary.mean:,.{cell.digits}f}".replace(",", "\u202f")
    spread = cell.summary.spread
    return text if spread is None else f"{text} ± {spread:.{cell.digits}f}"


def to_markdown(tables: Sequence[ResultTable], heading: str, paragraphs: Sequence[str]) -> str:
    """A document: heading, the tables, and paragraphs (already Markdown)."""
    parts = [f"# {escape_markdown(heading)}", *(_markdown_table(table) for table in tables), *paragraphs]
    return "\n\n".join(parts) + "\n"


def to_latex(tables: Sequence[ResultTable]) -> str:
    """One `table` for each table; they need the package booktabs."""
    return "% Made by `vdgs bench`. Needs \\usepackage{booktabs}.\n\n" + "\n\n".join(map(_latex_table, tables)) + "\n"


def to_tidy_csv(tables: Sequence[ResultTable]) -> str:
    """One line for each number: table, group, row, column, mean, spread, seeds, mark."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["table", "group", "row", "column", "mean", "spread", "seeds", "mark"])
    for table in tables:
        group = ""
        for row in table.rows:
            if not row.cells:
                group = row.label
            for column, cell in zip(table.columns, row.cells, strict=bool(row.cells)):
                if cell.summary is not None:
                    spread = "" if cell.summary.spread is None else repr(cell.summary.spread)
                    writer.writerow([table.name, group, row.label, column, repr(cell.summary.mean), spread,
                                     cell.summary.count, cell.mark])  # fmt: skip
    return file.getvalue()


def _markdown_table(table: ResultTable) -> str:
    lines = [f"## {escape_markdown(table.title)}", ""]
    said = any(row.rests_on for row in table.rows)
    heads = ["method", *map(escape_markdown, table.columns), *["rests on"] * said]
    lines.append("| " + " | ".join(heads) + " |")
    lines.append("|---|" + "---:|" * len(table.columns) + "---|" * said)
    for row in table.rows:
        if row.cells:
            cells = [
                escape_markdown(row.label),
                *map(_markdown_cell, row.cells),
                *[escape_markdown(row.rests_on)] * said,
            ]
            lines.append("| " + " | ".join(cells) + " |")
        else:
            lines.append(f"| *{escape_markdown(row.label)}* |" + " |" * (len(table.columns) + said))
    for note in table.notes:
        lines += ["", escape_markdown(note)]
    return "\n".join(lines)


def _markdown_cell(cell: TableCell) -> str:
    text = format_cell(cell)
    return {"best": f"**{text}**", "second": f"<u>{text}</u>", "": text}[cell.mark]


def _latex_table(table: ResultTable) -> str:
    lines = [r"\begin{table}[htbp]", r"\centering", rf"\caption{{{escape_latex(table.title)}}}"]
    lines.append(rf"\label{{tab:{re.sub('[^a-z0-9-]', '-', table.name.lower())}}}")
    said = any(row.rests_on for row in table.rows)
    lines += [r"\begin{tabular}{l" + "r" * len(table.columns) + "l" * said + "}", r"\toprule"]
    heads = ["method", *map(escape_latex, table.columns), *["rests on"] * said]
    lines += [" & ".join(heads) + r" \\", r"\midrule"]
    for row in table.rows:
        if row.cells:
            cells = [escape_latex(row.label), *map(_latex_cell, row.cells), *[escape_latex(row.rests_on)] * said]
            lines.append(" & ".join(cells) + r" \\")
        else:
            lines.append(
                rf"\multicolumn{{{len(table.columns) + 1 + said}}}{{l}}{{\textit{{{escape_latex(row.label)}}}}} \\"
            )
    lines += [r"\bottomrule", r"\end{tabular}"]
    lines += [rf"\par\smallskip {escape_latex(note)}" for note in table.notes]
    return "\n".join([*lines, r"\end{table}"])


def _latex_cell(cell: TableCell) -> str:
    text = escape_latex(format_cell(cell)).replace("\u202f", r"\,")
    return {"best": rf"\textbf{{{text}}}", "second": rf"\underline{{{text}}}", "": text}[cell.mark]
