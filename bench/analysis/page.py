"""The report as one HTML file, without scripts, that loads nothing."""

from __future__ import annotations

import base64
import re
from html import escape

from report import INCOMPLETE, Report
from styles import Style, styles
from tables import SMOKE_TEST, Table

# Facts about the machine in the line below the title.
ORIGIN = ("measured", "board", "processor", "kernel", "revision")

STYLE = """
:root { --ink: #1a1c1e; --soft: #5b6166; --paper: #fff; --line: #d5d9dc; --band: #f4f6f7; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e8ea; --soft: #a3abb1; --paper: #16191b; --line: #3a4146; --band: #1f2427; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1160px; padding: 1.5rem 1rem 4rem; color: var(--ink);
  background: var(--paper); font: 16px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0 0 .3rem; }
h2 { font-size: 1.25rem; line-height: 1.3; margin: 3rem 0 .8rem; padding-top: .8rem;
  border-top: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.6rem 0 .4rem; }
p, li { max-width: 75ch; overflow-wrap: break-word; }
a { color: inherit; }
.soft { color: var(--soft); font-size: .875rem; }
.mark { border: 2px solid; padding: .5rem .8rem; font-weight: 600; }
.box { overflow-x: auto; margin: .5rem 0; border: 1px solid var(--line); }
table { border-collapse: separate; border-spacing: 0; font-size: .875rem; min-width: 100%;
  font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .7rem; text-align: right; vertical-align: top; white-space: nowrap;
  border-bottom: 1px solid var(--line); }
tr:last-child td { border-bottom: 0; }
thead th { white-space: normal; min-width: 4.5rem; max-width: 11rem; vertical-align: bottom;
  background: var(--band); font-weight: 600; }
th:first-child, td:first-child { position: sticky; left: 0; text-align: left; white-space: normal;
  background: var(--paper); min-width: 9rem; max-width: 34rem;
  border-right: 1px solid var(--line); overflow-wrap: normal; }
thead th:first-child { background: var(--band); }
th .side { display: block; margin: 0 0 .2rem auto; }
.sides td:first-child, .wide td:first-child { min-width: 17rem; }
.texts td, .texts th { text-align: left; }
.side { display: inline-block; background: #fff; border-radius: 2px; margin-right: .4rem;
  vertical-align: middle; }
.cards { display: flex; flex-wrap: wrap; gap: 1rem; align-items: flex-start; margin: .8rem 0; }
.cards img { display: block; background: #fff; width: 22rem; max-width: 100%; height: auto;
  border: 1px solid var(--line); }
dl { display: grid; grid-template-columns: minmax(7rem, auto) 1fr; gap: .2rem 1rem;
  font-size: .875rem; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
@media (max-width: 600px) {
  th:first-child, td:first-child { min-width: 8rem; max-width: 9.5rem; }
  .sides td:first-child, .wide td:first-child { min-width: 9rem; max-width: 10.5rem; }
  .sides .side { display: block; margin: .3rem 0 0; }
  th, td { padding: .3rem .5rem; }
}
@media print { .box { overflow: visible; } h2, .cards img { break-inside: avoid; } }
"""


def to_html(report: Report, drawn: dict[str, dict[str, bytes]]) -> str:
    """The page, with the figures of each section: `drawn` has their names and SVG files."""
    looks = styles(report.side_names())
    results = report.results
    facts = results.machine.facts
    origin = " · ".join(facts[name] for name in ORIGIN if name in facts)
    parts = [f"<h1>{escape(report.title)}</h1>", f'<p class="soft">{escape(origin)}</p>']
    if results.is_quick:
        parts.append(f'<p class="mark">This is a {SMOKE_TEST}: its values are not meaningful.</p>')
    if not results.is_complete:
        parts.append(f'<p class="mark">{INCOMPLETE}</p>')
    if report.goals:
        parts.append(f'<p>{escape(report.goals)} See <a href="#measurements">all goals</a>.</p>')
    if report.headline:
        links = {row[0]: one.slug for one in report.groups for row in report.headline.rows
                 if row[0] == f"{one.group.name}, {one.unit}"}
        parts += [_table(report.headline, looks, links), _cards(drawn.get("", {}))]
    for section in report.sections():
        first, *others = section.tables
        parts.append(f'<h2 id="{section.slug}">{escape(first.title)}</h2>')
        parts.append(_cards(drawn.get(section.slug, {})))
        parts.append(_table(first, looks, {}, has_title=False))
        parts += [_table(table, looks, {}) for table in others]
    if report.measurements:
        parts.append(f'<h2 id="measurements">{escape(report.measurements.title)}</h2>')
        parts.append(_table(report.measurements, looks, {}, has_title=False))
    if results.notes:
        # The page has no markup of Markdown.
        notes = "".join(f"<li>{escape(re.sub('[*`]', '', note))}</li>" for note in results.notes)
        parts.append(f"<h2>Notes</h2><ul>{notes}</ul>")
    terms = "".join(f"<dt>{escape(key)}</dt><dd>{escape(fact)}</dd>" for key, fact in facts.items())
    parts.append(f"<h2>Machine</h2><dl>{terms}</dl>")
    body = "\n".join(part for part in parts if part)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(report.title)}</title><style>{STYLE}</style></head>\n"
        f"<body>\n{body}\n</body></html>\n"
    )


def _cards(figures: dict[str, bytes]) -> str:
    images = []
    for name, content in figures.items():
        # An image has no scripts, and its identifiers do not meet those of other images.
        data = base64.b64encode(content).decode()
        images.append(f'<img alt="{escape(name)}" src="data:image/svg+xml;base64,{data}">')
    return f'<div class="cards">{"".join(images)}</div>' if images else ""


def _table(
    table: Table, looks: dict[str, Style], links: dict[str, str], has_title: bool = True
) -> str:
    heads = "".join(f"<th>{_swatch(head, table, looks)}{escape(head)}</th>" for head in table.heads)
    rows = []
    for row in table.rows:
        first = escape(row[0])
        if row[0] in links:
            first = f'<a href="#{links[row[0]]}">{first}</a>'
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in row[1:])
        rows.append(f"<tr><td>{_swatch(row[0], table, looks)}{first}</td>{cells}</tr>")
    title = f"<h3>{escape(table.title)}</h3>" if has_title else ""
    kind = "box sides" if set(table.sides) & {row[0] for row in table.rows} else "box wide"
    if table.title.startswith("Details"):
        kind += " texts"
    notes = "".join(f'<p class="soft">{escape(note)}</p>' for note in table.notes)
    # A box that scrolls can be reached by the keyboard.
    return (
        f'{title}<div class="{kind}" tabindex="0" role="region" aria-label="{escape(table.title)}">'
        f"<table><thead><tr>{heads}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>{notes}"
    )


def _swatch(cell: str, table: Table, looks: dict[str, Style]) -> str:
    """The line of a side, as in the figures, before its name."""
    name = cell[: -len(" (invalid)")] if cell.endswith(" (invalid)") else cell
    if name not in table.sides:
        return ""
    style = looks[name]
    dashes = " ".join(f"{2 * length:g}" for length in style.dashes)
    return (
        '<svg class="side" width="48" height="10" aria-hidden="true"><line x1="2" y1="5" x2="46" '
        f'y2="5" stroke="{style.colour}" stroke-width="2.5" stroke-dasharray="{dashes}"/></svg>'
    )
