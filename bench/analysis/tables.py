"""Tables as Markdown, LaTeX and CSV, and the form of their numbers."""

from __future__ import annotations

import csv
import io
import math
import re
import textwrap
from dataclasses import dataclass, field, replace
from typing import Iterable, Sequence

from stats import Difference

SMOKE_TEST = "smoke test"
COMPARED = ("median ratio", "95 % interval", "effect (Cliff's delta)", "p (Mann-Whitney U)")


@dataclass(frozen=True)
class Table:
    """A table of texts. Its first column has names; `sides` are those that have a style."""

    title: str
    heads: list[str]
    rows: list[list[str]]
    notes: list[str] = field(default_factory=list)
    sides: list[str] = field(default_factory=list)

    def marked(self, is_quick: bool) -> Table:
        """The table with the mark of a smoke test in its title and all rows, if it is one."""
        if not is_quick:
            return self
        rows = [[*row, SMOKE_TEST] for row in self.rows]
        title = f"{self.title} ({SMOKE_TEST})"
        return replace(self, title=title, heads=[*self.heads, "status"], rows=rows)


def micro(text: str) -> str:
    """The text with the usual sign of microseconds, where it is a unit."""
    return re.sub(r"(?<=\d )us\b|(?<=, )us$|^us\b", "µs", text)


def number(value: float) -> str:
    """The value with three significant digits; a whole number has all of its digits."""
    if not math.isfinite(value):
        return "-"
    if abs(value) < 1e-9:
        # A difference of equal values, such as of a power and that of the idle machine.
        value = 0.0
    if value == int(value) and abs(value) < 1e15:
        return f"{value:.0f}" if value == 0 or abs(value) >= 100 else f"{value:#.3g}"
    text = f"{value:#.3g}"
    if "e" in text and 1e-5 <= abs(value) < 1e15:
        text = f"{float(text):.0f}" if abs(value) >= 1 else f"{float(text):.7f}".rstrip("0")
    return text.rstrip(".")


def goal_number(value: float) -> str:
    return f"{value:.10g}"


def interval_text(interval: tuple[float, float] | None) -> str:
    return f"{number(interval[0])} to {number(interval[1])}" if interval else "-"


def difference_cells(found: Difference) -> list[str]:
    """The cells below `COMPARED`."""
    if found.delta is None or found.p is None:
        few = "too few values"
        return [number(found.ratio) if found.ratio is not None else "-", few, few, few]
    # A median of 0 or less has no ratio.
    ratio = number(found.ratio) if found.ratio is not None else "-"
    p = "< 0.001" if found.p < 0.001 else f"{found.p:.3f}"
    return [ratio, interval_text(found.interval), f"{found.delta:+.2f}", p]


def markdown_text(text: str) -> str:
    text = re.sub(r"\s+", " ", text).replace("|", "\\|")
    return re.sub(r"<(?=[A-Za-z/!?])", r"\\<", text)


def markdown_rows(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """The table as Markdown, with a line for each row."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join(f"| {' | '.join(map(markdown_text, line))} |\n" for line in lines)


def to_markdown(table: Table) -> str:
    """The table as Markdown, below its title."""
    title = f"{markdown_text(table.title)}:\n\n" if table.title else ""
    notes = "".join(f"\n{markdown_text(note)}\n" for note in table.notes)
    return f"{title}{markdown_rows(table.heads, table.rows)}{notes}"


_LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\textquotedbl{}",
    "µ": r"\textmu{}",
    "×": r"$\times$",
}


def latex_text(text: str) -> str:
    """The text for LaTeX, which prints it as it is."""
    return "".join(_LATEX.get(char, char) for char in re.sub(r"\s+", " ", text))


def _latex_head(text: str) -> str:
    lines = [latex_text(line) for line in textwrap.wrap(text, 14, break_long_words=False)]
    return r"\shortstack[r]{" + r" \\ ".join(lines) + "}" if len(lines) > 1 else latex_text(text)


def to_latex(table: Table, label: str, caption: str) -> str:
    """The table for `booktabs`, across both columns of a page."""
    columns = "l" + "r" * (len(table.heads) - 1)
    lines = [
        r"% \usepackage{booktabs}",
        r"\begin{table*}",
        r"  \centering\footnotesize\setlength{\tabcolsep}{4pt}",
        rf"  \caption{{{latex_text(caption)}}}\label{{tab:{label}}}",
        r"  % A table that is wider than the page: \resizebox{\textwidth}{!}{...} of graphicx.",
        rf"  \begin{{tabular}}{{{columns}}}",
        r"    \toprule",
        rf"    {' & '.join(map(_latex_head, table.heads))} \\",
        r"    \midrule",
        *(rf"    {' & '.join(map(latex_text, row))} \\" for row in table.rows),
        r"    \bottomrule",
        r"  \end{tabular}",
        *(rf"  \par\smallskip {{\scriptsize {latex_text(note)}}}" for note in table.notes),
        r"\end{table*}",
    ]
    return "\n".join(lines) + "\n"


def to_csv(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Rows with all digits of their numbers; None is an empty cell. A text that a spreadsheet
    would take as a formula begins with an apostrophe."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(heads)
    writer.writerows([_csv_cell(cell) for cell in row] for row in rows)
    return text.getvalue()


def _csv_cell(cell: object) -> object:
    # A text of signs only, such as a hatch, computes nothing.
    is_formula = isinstance(cell, str) and re.match(r"[=+\-@\t\r].*\w", cell, re.DOTALL)
    return f"'{cell}" if is_formula else cell
